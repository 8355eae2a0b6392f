"""One person of NeRSemble's benchmark for monocular FLAME avatars (mono_flame_avatar), one or several cameras.

    FOLDER/calibration/camera_params.json                     poses (world to camera, OpenCV's axes) and intrinsics
    FOLDER/sequences/SEQ/images/cam_SERIAL.mp4
    FOLDER/sequences/SEQ/alpha_maps/cam_SERIAL.mp4            the matte, in its first channel
    FOLDER/sequences/SEQ/tracking/flame2023_tracking_v2.npz   FLAME 2023, a row for each tracked picture

The pictures are decoded into the cache. There are no eyelids: they are zero. The identity of the first sequence is used
for all.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar.errors import UserError
from avatar.files.environment import cache_folder
from avatar.files.names import safe_name
from avatar.head.assets import HeadAssets
from avatar.head.model import NECK
from data_prep.formats.frame_files import FrameFiles, KindNames
from data_prep.formats.frame_track import FrameTrack, Tracking, read_frames
from data_prep.formats.nersemble_cameras import CALIBRATION, read_cameras
from data_prep.formats.nersemble_tracking import FILES, SequenceTracking, find_tracking, read_tracking
from data_prep.formats.root_pose import Joint
from data_prep.formats.tracked_folder import Shot, TrackedFolder
from data_prep.formats.train_test_split import ALL, chosen_cameras
from data_prep.formats.video_frames import WantedVideo, decode_videos, look_into

NAME = "NeRSemble"
NAMES = KindNames("alpha_maps/", "head masks", "mouth masks", images="images/", tracking="tracking/")
SEQUENCES = "sequences"
TRAINED_CAMERA = "222200037"  # the front one; the benchmark holds the others out
TESTED = re.compile(r"(FREE|EMO-1|SEN-09|SEN-10)(?![0-9A-Za-z])", re.I)  # beginnings of sequences' names
MAX_SCALE_CHANGE = 1e-3  # between sequences of several cameras; 1 mm of a metre


class Sequence(NamedTuple):
    folder: Path
    tracking: SequenceTracking
    images: dict[str, Path]  # videos by serial
    mattes: dict[str, Path]


class Row(NamedTuple):
    """Which tracking a picture has."""

    sequence: int
    row: int


Wanted = dict[tuple[int, str], WantedVideo]  # by sequence and serial


def recognise(folder: Path) -> bool:
    return (folder / CALIBRATION).is_file() and (folder / SEQUENCES).is_dir()


def open_folder(folder: Path, cameras: str = ALL) -> TrackedFolder:
    """`cameras` is "all", "front" or serials between commas. Decodes the videos.

    Raises UserError for what is missing or does not fit together, and for cameras that there are not.
    """
    sequences, notes = _read_sequences(folder)
    sequences, more = _of_cameras(sequences, cameras, folder)
    serials = sorted({serial for sequence in sequences for serial in sequence.images})
    key = hashlib.sha256(str(folder.resolve()).encode(errors="surrogateescape")).hexdigest()[:12]
    root = cache_folder() / "frames" / f"{safe_name(folder.name)}-{key}"
    images, mattes = _wanted(sequences, root)
    calibrated = read_cameras(folder, _sizes(images, mattes))
    decode_videos(root, [*images.values(), *mattes.values()])
    files, shots, rows = _numbered(sequences, images, mattes, root, folder / CALIBRATION)
    is_rig = len(serials) > 1
    if is_rig:
        _refuse_scales(sequences)

    shape, cameras_of = sequences[0].tracking.shape, {number: shot.camera for number, shot in shots.items()}

    def read(head: HeadAssets, _size: tuple[int, int], complain: Callable[[str], object]) -> Tracking:
        neck = Joint(head, NECK)

        def read_picture(number: int) -> FrameTrack:
            sequence, row = rows[number]
            return sequences[sequence].tracking.frame(row, shape, neck, calibrated[cameras_of[number]])

        return read_frames({number: number for number in rows}, read_picture, files.tracking, complain, cameras_of)

    return TrackedFolder(
        NAME,
        files,
        read,
        _division(sequences, rows, shots),
        (*notes, *more),
        _rate(images),
        shots=shots if is_rig else {},
    )


def _read_sequences(folder: Path) -> tuple[list[Sequence], list[str]]:
    """Those that are tracked and filmed, in the order of their names; and notes."""
    found: list[Sequence] = []
    untracked, unfilmed = [], []
    for place in sorted(path for path in (folder / SEQUENCES).iterdir() if path.is_dir()):
        tracking, videos = find_tracking(place), camera_videos(place / "images")
        if tracking is None:
            untracked.append(place.name)
        elif not videos:
            unfilmed.append(place.name)
        else:
            found.append(Sequence(place, read_tracking(tracking), videos, camera_videos(place / "alpha_maps")))
    if not found:
        raise UserError(
            f"no sequence in {folder / SEQUENCES} has images/cam_SERIAL.mp4 and tracking/{FILES[0]}; track a "
            "sequence first (avatar track ID/sequences/SEQ), or download the benchmark's mono_flame_avatar"
        )
    notes = [
        f"sequences without {what} are left out: {', '.join(names)}"
        for what, names in (("tracking", untracked), ("videos", unfilmed))
        if names
    ]
    if any(not np.array_equal(one.tracking.shape, found[0].tracking.shape) for one in found):
        notes.append("the sequences have an identity each: that of the first is used for all")
    return found, notes


def camera_videos(folder: Path) -> dict[str, Path]:
    """cam_SERIAL.mp4 by serial. Raises UserError for an .mp4 file of another name, as of a repeated download."""
    videos: dict[str, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.name.startswith(".") or path.suffix.lower() != ".mp4":
            continue
        serial = re.fullmatch(r"cam_([0-9]{1,20})", path.stem)
        if serial is None or serial[1] in videos:
            raise UserError(f"{path} is not named cam_SERIAL.mp4, or is the second of its serial; rename or remove it")
        videos[serial[1]] = path
    return videos


def _of_cameras(sequences: list[Sequence], cameras: str, folder: Path) -> tuple[list[Sequence], list[str]]:
    """The sequences with the videos of the chosen cameras alone; and notes on those that are not there."""
    serials = sorted({serial for sequence in sequences for serial in sequence.images})
    front = TRAINED_CAMERA if TRAINED_CAMERA in serials else serials[0]
    chosen, notes = chosen_cameras(cameras, serials, lambda: front, folder)
    kept = [
        one._replace(images={serial: path for serial, path in one.images.items() if serial in chosen})
        for one in sequences
    ]
    lacking = [f"{one.folder.name} by {c}" for one in kept for c in sorted(chosen) if c not in one.images]
    absent = [f"there is no video of {', '.join(lacking)}"] if lacking else []
    return [one for one in kept if one.images], [*absent, *notes]


def _wanted(sequences: list[Sequence], root: Path) -> tuple[Wanted, Wanted]:
    """The videos of pictures, and those of mattes: of all, or of none.

    Raises UserError for videos of a sequence that differ in their number of pictures.
    """
    images: Wanted = {}
    mattes: Wanted = {}
    for index, sequence in enumerate(sequences):
        first: tuple[Path, int] | None = None
        for serial, path in sequence.images.items():
            for wanted, video, name in (
                (images, path, serial),
                (mattes, sequence.mattes.get(serial), f"{serial}_alpha"),
            ):
                if video is None:
                    continue
                folder = root / sequence.folder.name / name
                facts = look_into(video, folder)
                first = first or (video, facts.count)
                if facts.count != first[1]:
                    raise UserError(
                        f"{video} has {facts.count} pictures, but {first[0]} has {first[1]}; download the shorter one "
                        "again, or leave its camera out with --cameras"
                    )
                pictures = sequence.tracking.pictures(facts.count)
                wanted[index, serial] = WantedVideo(video, folder, facts, pictures, wanted is mattes)
    if mattes and (bare := images.keys() - mattes.keys()):
        index, serial = min(bare)
        raise UserError(
            f"{sequences[index].folder / 'alpha_maps' / f'cam_{serial}.mp4'} is missing, while other videos have theirs; "
            "download it again"
        )
    return images, mattes


def _sizes(images: Wanted, mattes: Wanted) -> dict[str, tuple[int, int]]:
    """(width, height) of each camera's videos. Raises UserError where one has another size."""
    first: dict[str, WantedVideo] = {}
    for (_, serial), video in [*images.items(), *mattes.items()]:
        usual = first.setdefault(serial, video)
        if video.facts[:2] != usual.facts[:2]:
            (w, h), (width, height) = video.facts[:2], usual.facts[:2]
            raise UserError(
                f"{video.path} has {w}x{h} pixels, but {usual.path} has {width}x{height}; download them again"
            )
    return {serial: (video.facts.width, video.facts.height) for serial, video in first.items()}


def _numbered(
    sequences: list[Sequence], videos: Wanted, mattes: Wanted, root: Path, calibration: Path
) -> tuple[FrameFiles, dict[int, Shot], dict[int, Row]]:
    """Files, shots and rows by number; with one camera the numbers are the times. Between sequences a time is missing."""
    serials = sorted({serial for _, serial in videos})
    images: dict[int, Path] = {}
    alphas: dict[int, Path] = {}
    shots: dict[int, Shot] = {}
    rows: dict[int, Row] = {}
    time = -2
    for index, sequence in enumerate(sequences):
        pictures = next(video.pictures for (one, _), video in videos.items() if one == index)
        usual = min(np.diff(pictures), default=1)
        for row, picture in enumerate(pictures):
            time += 1 if row and picture - pictures[row - 1] == usual else 2
            for place, serial in enumerate(serials):
                if serial not in sequence.images:
                    continue
                number = time * len(serials) + place
                images[number] = videos[index, serial].files()[picture]
                if mattes:
                    alphas[number] = mattes[index, serial].files()[picture]
                shots[number], rows[number] = Shot(serial, time), Row(index, row)
    files = FrameFiles(
        folder=root,
        images=images,
        alphas=alphas,
        tracking={number: sequences[of.sequence].tracking.path for number, of in rows.items()},
        listings=(calibration,),
        paired_by=f"the frames in {sequences[0].tracking.path.name}",
        names=NAMES,
    )
    return files, shots, rows


def _division(sequences: list[Sequence], rows: dict[int, Row], shots: dict[int, Shot]) -> dict[int, str | None]:
    cameras = {shot.camera for shot in shots.values()}
    trained = {TRAINED_CAMERA} if TRAINED_CAMERA in cameras else cameras
    is_tested = [TESTED.match(sequence.folder.name) is not None for sequence in sequences]
    return {
        number: "test" if is_tested[of.sequence] else "train" if shots[number].camera in trained else "val"
        for number, of in rows.items()
    }


def _refuse_scales(sequences: list[Sequence]) -> None:
    """Raise UserError where sequences differ in scale: the same cameras would stand elsewhere in units of the head."""
    first = sequences[0]
    for other in sequences:
        if abs(other.tracking.scale / first.tracking.scale - 1) > MAX_SCALE_CHANGE:
            raise UserError(
                f"{other.tracking.path} has the scale {other.tracking.scale:g} and {first.tracking.path} "
                f"{first.tracking.scale:g}, so that their cameras do not agree; choose one camera with --cameras"
            )


def _rate(videos: Wanted) -> float | None:
    """Tracked pictures a second."""
    first = next(iter(videos.values()))
    return first.facts.rate and first.facts.rate / float(min(np.diff(first.pictures), default=1))
