"""A tracked folder and its head model, opened as a subject."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files.environment import named_path
from avatar.files.third_party import HEAD_VARIABLE
from avatar.head.assets import HeadAssets, load_head_assets
from data_prep.formats import avatar_track
from data_prep.prepare.prepare import prepare
from data_prep.prepare.wrong_inputs import check_folder


def find_head(folder: Path, given: Path | None = None) -> Path:
    """The head model of a subject: the one given, else FOLDER/head_model, else the one that the folder names, else
    $AVATAR_HEAD; UserError otherwise."""
    check_folder(folder)
    if given is not None:
        return given
    if (folder / "head_model").is_dir():
        return folder / "head_model"
    if (recorded := recorded_head(folder)) is not None:
        return recorded
    if named := named_path(HEAD_VARIABLE):
        return named
    raise UserError(
        f"no head model for {folder}: give --head PATH, or set {HEAD_VARIABLE}. FLAME 2023 Open (CC-BY-4.0) can be had "
        "from https://flame.is.tue.mpg.de; docs/data.md says which files belong into its folder"
    )


def recorded_head(folder: Path) -> Path | None:
    """Where the head model of the tracking was, if the folder says so and it is still there."""
    if not avatar_track.recognise(folder):
        return None
    path = Path(avatar_track.read_info(folder).head_path)
    return path if path.exists() else None


def open_subject(
    source: Source,
    test_frames: int | None = None,
    say: Callable[[str], object] = print,
    assets: HeadAssets | None = None,
    test_cameras: str | None = None,
) -> tuple[Subject, HeadAssets]:
    """Prepare the subject (from the cache when nothing changed) and open it with its head model.

    `assets` spares reading the head model where it is known. What is held out as in `prepare`, which also says what is
    raised.
    """
    check_folder(source.folder)
    if assets is None:
        assets = load_head_assets(source.head)
        for note in assets.notes:
            say(f"note: {note}")
    return Subject.open(prepare(source, assets, test_frames=test_frames, test_cameras=test_cameras, say=say)), assets
