"""The pictures and masks of a tracked folder: written once, read one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8

from avatar.compute.workers import in_order
from avatar.errors import UserError
from avatar.files.write_image import write_image
from data_prep.formats.frame_files import describe_numbers
from data_prep.progress import Progress
from data_prep.track.faces.landmarks import Landmarks
from data_prep.track.first_pass import FirstPass
from data_prep.track.footage.source import Footage, Span, TimedPicture, View
from data_prep.track.mattes.despill import despilled
from data_prep.track.mattes.user_mattes import OPAQUE, OwnMattes, share_on

WORKERS = 2
ROUNDING = 1e-3  # seconds by which the times of a picture and of its matte may differ: some files hold milliseconds
MAX_WITHOUT = 0.1  # of the frames may have a given matte that leaves out the face
Made = TypeVar("Made")
Read = Callable[[int], np.ndarray]  # the picture or the mask of the frame with this number


def frame_file(folder: Path, number: int) -> Path:
    return folder / f"{number:05d}.jpg"


def mask_file(folder: Path, number: int) -> Path:
    return folder / f"{number:05d}.png"


def in_view(landmarks: Landmarks, view: View) -> Landmarks:
    """Landmarks of the upright source pictures in the pixels of a view."""
    box = view.box
    scale = np.array([view.width / box.width, view.height / box.height, view.width / box.width])
    points = (landmarks.points - np.array([box.x, box.y, 0.0])) * scale
    points[~landmarks.detected] = 0.0
    return Landmarks(
        points.astype(np.float32), landmarks.scores, landmarks.detected, (view.width, view.height), landmarks.fps
    )


def write_frames(folder: Path, footage: Footage, view: View, span: Span, look: FirstPass, progress: Progress) -> None:
    """The view of every picture with the face, by frame number, as JPEG."""
    pictures = footage.read(view, span, lambda _: None)
    for number, picture in _chosen(pictures, footage.path, look, progress, "writing frames"):
        write_image(frame_file(folder, number), picture.image)


def write_given_mattes(
    folder: Path, mattes: OwnMattes, view: View, span: Span, look: FirstPass, progress: Progress
) -> list[int]:
    """The user's own mattes; returns the frames in which they leave out most of the face. Raises UserError where these are
    many, and where the mattes are not of all pictures."""
    points = in_view(look.landmarks, view).points
    without = []
    if span != Span():
        span = Span(max(0.0, look.between[0] - ROUNDING), look.between[1] + ROUNDING)
    pictures = mattes.read(view, span)
    for number, picture in _chosen(pictures, mattes.footage.path, look, progress, "writing mattes"):
        write_image(mask_file(folder, number), picture.image)
        if share_on(points[number, :, :2], picture.image)[0] < OPAQUE:
            without.append(number)
    total = int(look.landmarks.detected.sum())
    if len(without) > MAX_WITHOUT * total:
        raise UserError(
            f"the mattes in {mattes.footage.path} leave out most of the face in {len(without)} of {total} frames "
            f"({describe_numbers(without)}); make them again of the video's own pictures"
        )
    return without


def _chosen(
    pictures: Iterator[TimedPicture], path: Path, look: FirstPass, progress: Progress, title: str
) -> Iterator[tuple[int, TimedPicture]]:
    """The pictures that belong to the frames with a face, with the frames' numbers."""
    wanted = {int(look.pictures[number]): int(number) for number in np.flatnonzero(look.landmarks.detected)}
    steps = iter(progress(range(len(wanted)), len(wanted), title))
    count, last = 0, max(wanted)
    for n, picture in enumerate(pictures):
        count = n + 1
        if n in wanted:
            next(steps, None)
            yield wanted[n], picture
        if n >= last and not look.is_whole:
            break
    next(steps, None)
    if count <= last or (look.is_whole and count != look.read):
        raise UserError(
            f"{path} gives {count} pictures where {look.read} were expected: mattes must be of every picture of the video, "
            "and the video must not change meanwhile"
        )


def write_masks(
    folder: Path,
    numbers: Sequence[int],
    make: Callable[[int], UInt8[np.ndarray, "H W"]],
    progress: Progress,
    title: str,
) -> None:
    """What `make` gives for each frame number, as PNG; made by some threads, in any order."""

    def one(number: int) -> None:
        write_image(mask_file(folder, number), make(number))

    for _ in ahead(numbers, one, progress, title):
        pass


def write_despilled(
    folder: Path, numbers: Sequence[int], images: Read, mattes: Read, width: int, progress: Progress
) -> None:
    """The frames as `despill.despilled` makes them, as JPEG; by some threads."""

    def one(number: int) -> None:
        write_image(frame_file(folder, number), despilled(images(number), mattes(number), width))

    for _ in ahead(numbers, one, progress, "cleaning the outline"):
        pass


def ahead(
    numbers: Sequence[int], make: Callable[[int], Made], progress: Progress, title: str
) -> Iterator[tuple[int, Made]]:
    """Each frame number with what `make` gives for it, in order; made by some threads, a few frames ahead."""
    made = in_order(make, numbers, WORKERS)
    yield from zip(numbers, progress(made, len(numbers), title), strict=True)
