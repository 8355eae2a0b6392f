"""A video where a tracked folder is wanted: tracked once, and kept in the cache."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from tqdm import tqdm

from avatar.errors import UserError
from avatar.files.environment import cache_folder, named_path
from avatar.files.names import safe_name
from avatar.files.third_party import TRACKING_FILES, require
from avatar.head.assets import HeadAssets, load_head_assets
from data_prep.formats.avatar_track import recognise
from data_prep.prepare.checksums import find_damage, write_contents
from data_prep.prepare.open_subject import HEAD_VARIABLE
from data_prep.progress import Item
from data_prep.track.cache_key import tracking_key
from data_prep.track.faces.detect import load_mediapipe
from data_prep.track.footage.picture_folder import is_footage, open_footage
from data_prep.track.mattes.matting_network import check_matting
from data_prep.track.mattes.segmentation_network import matte_network
from data_prep.track.track import Choices, track


def head_for_video(video: Path, given: Path | None) -> Path:
    """The head model to track a video with: the one given, else $AVATAR_HEAD. Raises UserError without one."""
    if given is not None:
        return given
    if named := named_path(HEAD_VARIABLE):
        return named
    raise UserError(
        f"no head model to track {video} with: give --head PATH, or set {HEAD_VARIABLE}. Register at "
        "https://flame.is.tue.mpg.de, download FLAME 2023 Open (CC-BY-4.0) and unpack it into a folder; docs/data.md says "
        "which files belong there"
    )


def is_video(path: Path) -> bool:
    """Whether a command's SUBJECT is a video, or a folder of pictures, that has to be tracked first."""
    return not recognise(path) and is_footage(path)


def cached_tracking(video: Path, head: Path, assets: HeadAssets | None = None) -> Path:
    """The tracked folder of a video, in the cache by what the video and the head model hold; made where it is missing or
    damaged."""
    assets = assets or load_head_assets(head)
    key = tracking_key(open_footage(video), Choices().to_json(), head, assets)[:12]
    folder = cache_folder() / "tracked" / f"{safe_name(video.resolve().stem)}-{key}"
    if folder.is_dir():
        if (damage := find_damage(folder)) is None:
            print(f"using the tracking {folder}")
            return folder
        print(f"the tracking {folder} is damaged: {damage}; it is made again")
        shutil.rmtree(folder)
    track(video, folder, head, assets, progress=progress_bar, seal=write_contents)
    return folder


def tracking_lacks(*others: Callable[[], object]) -> list[str]:
    """All that tracking a video needs and this machine has not, each with what to do; `others` are checked first, and raise
    UserError for what is missing."""
    needed = [partial(require, file) for file in TRACKING_FILES if not file.is_optional]
    missing = []
    for check in (*others, load_mediapipe, *needed, lambda: check_matting(matte_network())):
        try:
            check()
        except UserError as error:
            missing.append(str(error))
    return missing


def progress_bar(items: Iterable[Item], total: int | None, title: str, unit: str = "frames") -> Iterable[Item]:
    """A progress bar with a rate, which leaves its line."""
    return tqdm(items, total=total, desc=title, unit=f" {unit}")
