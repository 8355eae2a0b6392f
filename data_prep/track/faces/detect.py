"""Faces in single pictures, by MediaPipe's Face Landmarker: 478 points and 52 blendshape scores each.

Pictures are taken one by one, not as MediaPipe's video: its filter over time follows quick movements late (measured on the
demo's people: errors of 1.3 to 1.6 % of the eyes' distance against 1.2 to 1.4), and the fit smooths with all frames known.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8

from avatar.errors import UserError, install
from avatar.files.third_party import FACE_LANDMARKER, require
from data_prep.track.faces.landmarks import NUM_POINTS

MAX_FACES = 4
INSTALL = f"tracking needs MediaPipe: {install('track')}"
_SMALL = 0.15  # of the longer side: smaller faces are overlooked in the whole picture (0.12 was found, 0.10 was not)
_WINDOW = 4.0  # heights of the face, around where it was
_FLAT = 3.0  # standard deviation of grey levels; a picture without contrast holds no face
_SAME = 0.3  # overlap (IoU) of boxes above which two findings are one face
# MediaPipe waits forever for a thread that is gone where the garbage collector closes a landmarker, so it never does.
_OPEN: list[Any] = []


class Face(NamedTuple):
    points: Float32[np.ndarray, "478 3"]  # x, y in pixels (centres at +0.5); z in the same unit, nearer is smaller
    scores: Float32[np.ndarray, "52"]

    @property
    def box(self) -> tuple[float, float, float, float]:
        """left, top, right, bottom of the landmarks."""
        low, high = self.points[:, :2].min(0), self.points[:, :2].max(0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    @property
    def height(self) -> float:
        return self.box[3] - self.box[1]


class FaceDetector:
    """A context manager; `find` is for the pictures of one clip in their order."""

    def __init__(self) -> None:
        self._mediapipe, self._landmarker = _load()
        _OPEN.append(self._landmarker)
        self._last: Face | None = None

    def __enter__(self) -> FaceDetector:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """For once; a detector that nobody closes stays in memory."""
        self._landmarker.close()
        _OPEN.remove(self._landmarker)

    def largest(self, image: UInt8[np.ndarray, "H W 3"]) -> Face | None:
        """The largest face of a picture that belongs to no clip."""
        faces = self._in_window(image, (0, 0, image.shape[1], image.shape[0]))
        return faces[0] if faces else None

    def anywhere(self, image: UInt8[np.ndarray, "H W 3"]) -> Face | None:
        """The same, of a picture whose face may be small."""
        return self.largest(image) or next(iter(self._in_parts(image)), None)

    def find(self, image: UInt8[np.ndarray, "H W 3"], begins_shot: bool = False) -> list[Face]:
        """The faces of a picture, the largest first; a small one is looked for around its last place, and in parts where it
        has none or a shot begins."""
        height, width = image.shape[:2]
        faces: list[Face] = []
        if self._last is not None and self._last.height < _SMALL * max(width, height):
            faces = self._in_window(image, _around(self._last, width, height))
        faces = faces or self._in_window(image, (0, 0, width, height))
        if not faces and self._last is not None:
            faces = self._in_window(image, _around(self._last, width, height))
        if not faces and (self._last is None or begins_shot) and image[::8, ::8].std() > _FLAT:
            faces = self._in_parts(image)
        if faces:
            near = faces if self._last is None else [f for f in faces if overlap(f.box, self._last.box) > 0]
            self._last = (near or faces)[0]
        return faces

    def _in_parts(self, image: np.ndarray) -> list[Face]:
        """The first finding in overlapping squares, from large to small ones."""
        height, width = image.shape[:2]
        for share in (1.0, 0.5):
            side = int(share * min(width, height))
            found: list[Face] = []
            for y in _steps(height, side):
                for x in _steps(width, side):
                    for face in self._in_window(image, (x, y, x + side, y + side)):
                        if all(overlap(face.box, other.box) < _SAME for other in found):
                            found.append(face)
            if found:
                return sorted(found, key=lambda face: -face.height)
        return []

    def _in_window(self, image: np.ndarray, window: tuple[int, int, int, int]) -> list[Face]:
        left, top, right, bottom = window
        part = np.ascontiguousarray(image[top:bottom, left:right])
        found = self._landmarker.detect(self._mediapipe.Image(image_format=self._mediapipe.ImageFormat.SRGB, data=part))
        faces = []
        for points, scores in zip(found.face_landmarks, found.face_blendshapes, strict=True):
            shares = np.array([(p.x, p.y, p.z) for p in points[:NUM_POINTS]], np.float32)
            # z is given in widths of the picture, as x is.
            unit, corner = (right - left, bottom - top, right - left), (left, top, 0)
            at = shares * np.array(unit, np.float32) + np.array(corner, np.float32)
            if at.shape == (NUM_POINTS, 3) and np.isfinite(at).all():
                faces.append(Face(at, np.array([s.score for s in scores], np.float32)))
        return sorted(faces, key=lambda face: -face.height)


def overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    """Intersection over union of two boxes (left, top, right, bottom)."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    both = width * height
    return both / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both)


def _around(face: Face, width: int, height: int) -> tuple[int, int, int, int]:
    left, top, right, bottom = face.box
    reach = 0.5 * _WINDOW * face.height
    x, y = (left + right) / 2, (top + bottom) / 2
    low = max(0, int(x - reach)), max(0, int(y - reach))
    high = min(width, int(x + reach) + 1), min(height, int(y + reach) + 1)
    return (*low, *high) if high[0] > low[0] and high[1] > low[1] else (0, 0, width, height)


def _steps(length: int, side: int) -> list[int]:
    """Starts of squares that overlap by half and cover the length."""
    count = 1 + max(0, -(-2 * (length - side) // side))
    return [round(k * (length - side) / max(count - 1, 1)) for k in range(count)]


def load_mediapipe() -> tuple[Any, Any, Callable[[Path], Any]]:
    """The package, its vision tasks, and what makes a task's options of a model file. UserError where it is missing."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    try:
        with quiet():
            import mediapipe
            from mediapipe.tasks.python import BaseOptions, vision
    except ImportError as error:
        raise UserError(f"{INSTALL} ({error})") from None
    return mediapipe, vision, lambda file: BaseOptions(model_asset_path=str(file))


def _load() -> tuple[Any, Any]:
    model = require(FACE_LANDMARKER)
    mediapipe, vision, options = load_mediapipe()
    settings = vision.FaceLandmarkerOptions(
        base_options=options(model), num_faces=MAX_FACES, output_face_blendshapes=True
    )
    try:
        with quiet():
            landmarker = vision.FaceLandmarker.create_from_options(settings)
            blank = np.zeros((64, 64, 3), np.uint8)  # the first call has more to say
            landmarker.detect(mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=blank))
    except (RuntimeError, ValueError, OSError) as error:
        raise UserError(f"MediaPipe cannot load {model} ({error}); {INSTALL}") from None
    return mediapipe, landmarker


_QUIET = threading.RLock()  # all threads have one standard error


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """MediaPipe's libraries write remarks of their own to the standard error's file, past Python."""
    with _QUIET:
        kept = os.dup(2)
        try:
            with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
                os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
