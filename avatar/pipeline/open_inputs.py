"""Runs, avatars, subjects and drivers, as commands name them."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files.names import ROUNDS_FOLDER
from avatar.motion.drive import Drive
from avatar.motion.drive_file import read_drive
from avatar.runs.run import Run, RunInfo, read_run_info
from avatar.runs.trained_avatar import TrainedAvatar, load_avatar
from data_prep.prepare.open_subject import find_head, open_subject
from data_prep.prepare.pairing import TooManyLeftOut
from data_prep.prepare.wrong_inputs import check_folder

DRIVE_SUFFIXES = (".npz", ".csv", ".json")


def source_of(arguments: Namespace) -> Source:
    """What the options of `add_source` say."""
    return Source(
        folder=arguments.folder,
        head=find_head(arguments.folder, arguments.head),
        **source_options(arguments, arguments.tracking),
    )


def source_options(arguments: Namespace, tracking: Path | None) -> dict[str, Any]:
    """What the options say of a tracked folder, as fields of a Source."""
    names = ("frame_offset", "data_format", "fps", "ignore_misfit", "cameras", "max_left_out")
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    return {"tracking": tracking, **given}


def open_run(
    path: Path, head: Path | None = None, folder: Path | None = None, say: Callable[[str], None] = print
) -> Run:
    """A run with its video; `folder` is where the video is now, if it has moved. Raises UserError when it has changed."""
    info = read_run_info(path)
    source = moved_source(path, info, head, folder)
    trained = load_avatar(path, head, recorded_head=source.head)
    data = trained.config.data
    try:
        subject, _ = open_subject(source, data.test_frames, say, trained.assets, data.test_cameras)
    except TooManyLeftOut as error:
        raise UserError(
            f"{error.problem}; the data is not what {path} was trained on: restore it, or train again"
        ) from None
    check_data(path, info, subject)
    check_division(path, trained.recording.split.to_lists(), subject)
    return Run(path, trained, subject)


def moved_source(path: Path, info: RunInfo, head: Path | None, folder: Path | None) -> Source:
    """The run's source, with what has moved at its new place; a run that has moved finds the folder of its last round."""
    source = info.source
    own = path.joinpath(*source.folder.parts[-3:])
    if folder is None and not source.folder.is_dir() and own.parts[-3:-2] == (ROUNDS_FOLDER,) and own.is_dir():
        folder = own
    if folder is not None:
        check_folder(folder)
        source = at_new_place(source, folder)
    elif not source.folder.is_dir():
        raise UserError(f"{source.folder}, on which {path} was trained, is gone: give its new place with --folder")
    return source if head is None else replace(source, head=head)


def at_new_place(source: Source, folder: Path) -> Source:
    """A source whose folder is now at `folder`, with the tracking and the head model that lay inside."""
    head = _moved(source.head, source.folder, folder)
    return replace(
        source,
        folder=folder,
        head=head if head.exists() else source.head,
        tracking=None if source.tracking is None else _moved(source.tracking, source.folder, folder),
    )


def _moved(path: Path, old: Path, new: Path) -> Path:
    """A path inside the old folder, inside the new one."""
    return new / path.relative_to(old) if path.is_relative_to(old) else path


def check_data(path: Path, info: RunInfo, subject: Subject) -> None:
    if subject.data_hash != info.data_hash:
        raise UserError(
            f"the data of {subject.name} is not what {path} was trained on: it has changed, or is another video; restore "
            "it, or train again"
        )


def check_division(path: Path, split: object, subject: Subject) -> None:
    """Raise UserError where the folder divides its frames otherwise than in the run's `Split.to_lists`: what was trained on
    would be held out."""
    if split != subject.split.to_lists():
        raise UserError(
            f"{subject.name} is divided into training and test frames otherwise than when {path} was trained: restore its "
            "listing, or train again"
        )


def open_driver(folder: Path, trained: TrainedAvatar, arguments: Namespace | None = None) -> Subject:
    """A tracked folder as driver: with its own head model where it has one, so that another one is noticed."""
    own = folder / "head_model"
    options = {} if arguments is None else source_options(arguments, arguments.driver_tracking)
    if not own.is_dir() or (arguments is not None and arguments.head is not None):
        return open_subject(Source(folder, trained.source, **options), None, print, trained.assets)[0]
    return open_subject(Source(folder, own, **options), None, print)[0]


def open_drive_file(path: Path, trained: TrainedAvatar) -> Drive:
    return read_drive(path, trained.assets, trained.recording.image_size(trained.config.data.size)[0])
