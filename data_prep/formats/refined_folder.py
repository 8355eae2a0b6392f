"""The folder that `avatar refine` writes: one of avatar track's, with how it was refined and what it was before.

    FOLDER/tracking.json, tracking.npz, frames/, matte/, head/, mouth/    as in `avatar_track`
    FOLDER/refinement.json     through which avatars, what they had been trained on, the division into training and test;
                               of several cameras their lenses and places, and the camera and time of each picture
    FOLDER/given.npz           the tracker's own tracking of the same frames, in the layout of tracking.npz
    FOLDER/refinement.csv      of each frame: how well it fitted before and after, and how far it moved
    FOLDER/refinement.png      some frames: as they are, with the tracking before and after

Pictures and masks are hard links to those of the subject, or copies where there can be none; label images and pictures
that are their own mattes are written out as masks. With several cameras, tracking.npz has a row for each time, with the
head's pose before the first of them, and pictures are numbered from 0.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from avatar.data.manifest import MASKS, Manifest
from avatar.data.read_image import read_matte
from avatar.data.recording import Recording
from avatar.data.refinement_history import Refinement
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files.atomic import check_target, whole_folder
from avatar.files.read import is_there
from avatar.files.write_image import write_image
from data_prep.formats import avatar_track
from data_prep.formats.avatar_track import FRAMES, HEAD, MATTE, MOUTH, TrackingInfo
from data_prep.formats.frame_track import FrameTrack, Tracking
from data_prep.formats.refined_rig import of_several_cameras, parse_pictures
from data_prep.formats.tracked_folder import TrackedFolder
from data_prep.formats.train_test_split import ALL, FRONT
from data_prep.formats.transforms import read_json

REFINEMENT_FILE, GIVEN_FILE = "refinement.json", "given.npz"
HEAD_MODEL = "head_model"
VERSION = 3


def open_folder(folder: Path, cameras: str = ALL) -> TrackedFolder:
    """A folder of avatar track, refined or not; `cameras` as in `vhap`. Raises UserError for one that is not whole."""
    tracked = avatar_track.open_folder(folder)
    path = folder / REFINEMENT_FILE
    if not is_there(path):
        return _of_one(tracked, cameras, folder)
    raw = read_json(path)
    if not isinstance(raw, dict) or raw.get("version") != VERSION:
        raise UserError(f"{path} is not of version {VERSION}, which this program reads; refine again")
    try:
        refinement = Refinement.from_dict(raw.get("refinement"))
        division = {int(number): str(part) for number, part in dict(raw["division"]).items()}
        pictures = None if raw["rig"] is None else parse_pictures(raw["rig"])
    except (UserError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged ({error}); refine again") from None
    last = refinement.rounds[-1]
    note = f"the tracking of {refinement.tracker} was refined through the avatar of {last.run} (step {last.step})"
    given = folder / GIVEN_FILE
    files = replace(tracked.files, listings=(*tracked.files.listings, path, given))
    refined = replace(
        tracked,
        files=files,
        division=division,
        notes=(*tracked.notes, note),
        refinement=refinement,
        read_given=lambda complain: _read_given(folder, files.tracking, complain),
    )
    return (
        _of_one(refined, cameras, folder)
        if pictures is None
        else of_several_cameras(refined, pictures, cameras, folder)
    )


def _of_one(tracked: TrackedFolder, cameras: str, folder: Path) -> TrackedFolder:
    if cameras not in (ALL, FRONT):
        raise UserError(f"--cameras is for folders of several cameras, and {folder} is of one")
    return tracked


def _read_given(folder: Path, tracked: Mapping[int, Path], complain: Callable[[str], object]) -> Tracking:
    given = avatar_track.read_tracks(folder, GIVEN_FILE, complain)
    if missing := sorted(tracked.keys() - given.frames.keys()):
        complain(f"{folder / GIVEN_FILE} lacks {len(missing)} of the frames, the first is {missing[0]}; refine again")
    return given


def write_folder(
    target: Path,
    subject: Subject,
    tracks: Mapping[str, Tensor],
    refinement: Refinement,
    extras: Mapping[str, bytes],
) -> None:
    """Write `target`, which is there whole or not at all: the subject's pictures with `tracks` (as `Recording.tracks`).

    extras   further files by name
    Raises UserError when it exists already or the disk refuses.
    """
    check_target(target)
    with whole_folder(target) as building:
        _link_pictures(building, subject)
        head = _head_model(building, subject)
        given = (subject.given or subject.recording).tracks
        info = _info(subject, str((target / HEAD_MODEL).resolve()) if head else subject.manifest.head_path)
        avatar_track.write_tracking(building, info, _frame_tracks(subject, given))
        (building / avatar_track.TRACKS_FILE).rename(building / GIVEN_FILE)
        avatar_track.write_tracking(building, info, _frame_tracks(subject, tracks))
        content = {
            "version": VERSION,
            "refinement": refinement.to_dict(),
            "division": _division(subject),
            "rig": _rig(subject),
        }
        (building / REFINEMENT_FILE).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        for name, data in extras.items():
            (building / name).write_bytes(data)


def frame_numbers(subject: Subject) -> list[int]:
    """The number of each frame in a refined folder."""
    return [subject.manifest.number(index) for index in range(len(subject))]


def _rig(subject: Subject) -> dict[str, Any] | None:
    rig = subject.recording.rig
    return None if rig is None else rig.to_dict() | {"numbers": frame_numbers(subject)}


def _link_pictures(building: Path, subject: Subject) -> None:
    manifest = subject.manifest
    source = Path(manifest.source)
    roots = {
        HEAD: subject.folder if manifest.head_masks == "derived" else source,
        MOUTH: subject.folder if manifest.mouth_masks == "derived" else source,
    }
    labels: dict[str, int | None] = dict(zip((MATTE, HEAD, MOUTH), map(manifest.labels.get, MASKS), strict=True))
    for number, record in zip(frame_numbers(subject), manifest.frames, strict=True):
        kinds = {FRAMES: record.image, MATTE: record.alpha, HEAD: record.head_mask, MOUTH: record.mouth_mask}
        for kind, path in kinds.items():
            if path is None:
                continue
            (building / kind).mkdir(exist_ok=True)
            file, label = roots.get(kind, source) / path, labels.get(kind)
            if label is None and not (kind == MATTE and path == record.image):
                _link(file, building / kind / f"{number:05d}{Path(path).suffix}")
                continue
            # Labels and pictures that are their own mattes are no masks of this layout.
            mask = read_matte(file, source / record.image, label)
            write_image(building / kind / f"{number:05d}.png", mask)
    landmarks = source / avatar_track.LANDMARKS_FILE
    if manifest.format == avatar_track.NAME and landmarks.is_file():
        _link(landmarks, building / avatar_track.LANDMARKS_FILE)


def _head_model(building: Path, subject: Subject) -> bool:
    """Take the head model along where it lies in the subject's own folder; elsewhere it stays, for its licence's sake."""
    head = Path(subject.manifest.head_path)
    if head != Path(subject.manifest.source) / HEAD_MODEL or not head.is_dir():
        return False
    (building / HEAD_MODEL).mkdir()
    for path in sorted(head.iterdir()):
        if path.is_file():
            _link(path, building / HEAD_MODEL / path.name)
    return True


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source.resolve(), target)
    except OSError:  # another disk, or one without links
        shutil.copy2(source, target)


def _info(subject: Subject, head_path: str) -> TrackingInfo:
    manifest = subject.manifest
    focal, is_assumed = "that of the tracking before", False
    if manifest.format == avatar_track.NAME:
        before = avatar_track.read_info(Path(manifest.source))
        focal, is_assumed = before.focal, before.focal_is_assumed
    return TrackingInfo(
        fps=manifest.fps,
        width=manifest.width,
        height=manifest.height,
        intrinsics=manifest.intrinsics,
        focal=focal,
        focal_is_assumed=is_assumed,
        head_path=head_path,
        head_fingerprint=manifest.head_fingerprint,
        source={"folder": manifest.source, "format": manifest.format, "data_hash": manifest.data_hash},
        left_out=_left_out(manifest),
        notes=manifest.notes,
    )


def _left_out(manifest: Manifest) -> dict[int, str]:
    """By number; nothing where the images' names do not end in their numbers, and of several cameras."""

    def numbers(name: str) -> list[int]:
        return [int(digits) for digits in re.findall(r"[0-9]+$", name)]

    is_named = all(numbers(record.name) == [manifest.number(n)] for n, record in enumerate(manifest.frames))
    if manifest.rig is not None or not is_named:
        return {}
    return {number: why for name, why in manifest.left_out.items() for number in numbers(name)}


def _frame_tracks(subject: Subject, tracks: Mapping[str, Tensor]) -> dict[int, FrameTrack]:
    recording: Recording = subject.recording
    arrays = {name: value.double().numpy() for name, value in tracks.items()}
    numbers = frame_numbers(subject)
    if recording.rig is not None:  # of the times
        numbers = [subject.manifest.frames[index].tracking for index in recording.moments(range(len(recording)))]
    return {
        number: FrameTrack(
            **{name: array[row] for name, array in arrays.items() if name != "shape"},
            shape=arrays["shape"],
            intrinsics=np.array(recording.intrinsics),
            size=(recording.width, recording.height),
        )
        for row, number in enumerate(numbers)
    }


def _division(subject: Subject) -> dict[str, str]:
    numbers = frame_numbers(subject)
    parts = {"train": subject.split.train, "test": subject.split.test}
    return {str(numbers[index]): part for part, indices in parts.items() for index in indices}
