"""The pictures of one camera of a rig, read once: written at the wanted size, with the face's landmarks in each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from avatar.errors import UserError
from avatar.files.write_image import write_image
from data_prep.track.camera_rig.recording import Recording
from data_prep.track.faces.detect import Face, FaceDetector
from data_prep.track.first_pass import DETECTION_SIDE
from data_prep.track.footage.picture_folder import resampled
from data_prep.track.footage.source import Box, Footage, Span, View, whole
from data_prep.track.frames import frame_file, mask_file

_SAMPLES = 3  # first pictures, by which the front camera is found
_LEFT_EYE, _RIGHT_EYE, _MOUTH = 263, 33, 13  # landmarks of a plane that the face looks along the normal of
_OFF = 0.3  # of the distance between two times, by which a picture may be off one


class Times(NamedTuple):
    """Which pictures are used: number n is at `begins` + n / `fps` seconds."""

    numbers: Sequence[int]
    begins: float
    fps: float

    def seconds(self, number: float) -> float:
        return self.begins + number / self.fps

    def pick(self, footage: Footage, view: View) -> Iterator[tuple[int, np.ndarray]]:
        """The nearest picture of each time, of all that the camera has: it need not have begun with the others."""
        span = Span(max(0.0, self.begins - 1 / self.fps), self.begins + (max(self.numbers) + 1) / self.fps)
        timed = (
            ((time - self.begins) * self.fps, image) for time, image in footage.read(view, span, lambda _: None, 1)
        )
        wanted = set(self.numbers)
        for number, near in groupby(timed, lambda one: round(one[0])):
            place, image = min(near, key=lambda one: abs(one[0] - number))
            if number in wanted and abs(place - number) < _OFF:
                yield number, image


def find_front(recording: Recording, span: Span) -> str:
    """The camera before the face. Raises UserError where no camera shows one in its first pictures."""
    if recording.front is not None:
        return recording.front
    facing: dict[str, float] = {}
    with FaceDetector() as detector:
        for serial, camera in recording.cameras.items():
            footage = camera.footage
            pictures = footage.read(whole(footage.width, footage.height, DETECTION_SIDE), span, lambda _: None)
            faces = [detector.anywhere(picture.image) for _, picture in zip(range(_SAMPLES), pictures, strict=False)]
            if seen := [_frontality(face) for face in faces if face is not None]:
                facing[serial] = float(np.median(seen))
    if not facing:
        raise UserError(
            f"no face was found in the first {_SAMPLES} pictures of any camera of {recording.folder}: one must see it from "
            "the front, lit, and not as a speck"
        )
    return max(facing, key=facing.__getitem__)


def _frontality(face: Face) -> float:
    """Cosine of the angle between the camera's axis and where the face looks."""
    left, right, mouth = (face.points[n].astype(np.float64) for n in (_LEFT_EYE, _RIGHT_EYE, _MOUTH))
    normal = np.cross(left - right, mouth - right)
    return float(abs(normal[2]) / max(np.linalg.norm(normal), 1e-9))


def detection_view(view: View, footage: Footage) -> View:
    """The size at which pictures are read: enough for the landmarks and for the view."""
    return whole(footage.width, footage.height, max(DETECTION_SIDE, view.width, view.height))


def write_pictures(
    folder: Path, timed: Iterable[tuple[int, np.ndarray]], view: View, landmarks: np.ndarray
) -> dict[int, list[list[float]] | None]:
    """Write the whole pictures at the view's size; by number the `landmarks` in its pixels, None without a face."""
    found: dict[int, list[list[float]] | None] = {}
    with FaceDetector() as detector:
        for number, image in timed:
            large = View(Box(0, 0, image.shape[1], image.shape[0]), view.width, view.height)
            small = resampled(image, large)
            write_image(frame_file(folder, number), small)
            faces = detector.find(image)
            scale = np.array([view.width / image.shape[1], view.height / image.shape[0]])
            points = faces[0].points[landmarks, :2] * scale if faces else None
            found[number] = None if points is None else np.round(points, 2).tolist()
    return found


def copy_mattes(folder: Path, mattes: Footage, view: View, times: Times) -> None:
    for number, image in times.pick(mattes, view):
        write_image(mask_file(folder, number), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
