"""The face landmarks of a clip, and the file that they are kept in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from avatar.errors import UserError
from avatar.files.pickles import load_npz, save_npz

NUM_POINTS = 478  # 468 of the face mesh, then five of each iris
BLENDSHAPES = (
    "_neutral", "browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff",
    "cheekSquintLeft", "cheekSquintRight", "eyeBlinkLeft", "eyeBlinkRight", "eyeLookDownLeft", "eyeLookDownRight",
    "eyeLookInLeft", "eyeLookInRight", "eyeLookOutLeft", "eyeLookOutRight", "eyeLookUpLeft", "eyeLookUpRight",
    "eyeSquintLeft", "eyeSquintRight", "eyeWideLeft", "eyeWideRight", "jawForward", "jawLeft", "jawOpen", "jawRight",
    "mouthClose", "mouthDimpleLeft", "mouthDimpleRight", "mouthFrownLeft", "mouthFrownRight", "mouthFunnel",
    "mouthLeft", "mouthLowerDownLeft", "mouthLowerDownRight", "mouthPressLeft", "mouthPressRight", "mouthPucker",
    "mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthSmileLeft",
    "mouthSmileRight", "mouthStretchLeft", "mouthStretchRight", "mouthUpperUpLeft", "mouthUpperUpRight",
    "noseSneerLeft", "noseSneerRight",
)  # fmt: skip
"""Columns of the scores, in the order in which MediaPipe's Face Landmarker gives them."""

CLOSED_SCORE = 0.6  # of eyeBlink: closed eyes have this or a little more
_MAX_FRAMES = 1_000_000


@dataclass(frozen=True)
class Landmarks:
    """MediaPipe Face Landmarker's findings of one clip of T frames."""

    points: Float32[np.ndarray, "T 478 3"]  # x, y in pixels of the clip's frames (+0.5), z in MediaPipe's units x width
    scores: Float32[np.ndarray, "T 52"]  # of BLENDSHAPES, 0 to 1
    detected: Bool[np.ndarray, " T"]  # rows of the other frames are zero
    size: tuple[int, int]  # width and height of the frames
    fps: float

    def __len__(self) -> int:
        return len(self.points)

    def score(self, name: str) -> Float32[np.ndarray, " T"]:
        """One blendshape's scores. Raises ValueError for a name that is not in `BLENDSHAPES`."""
        return self.scores[:, BLENDSHAPES.index(name)]

    def open_shares(self) -> Float[np.ndarray, "T 2"]:
        """How far the left and the right eye are open, 0 to 1, by their scores."""
        blinks = np.stack((self.score("eyeBlinkLeft"), self.score("eyeBlinkRight")), axis=1).astype(np.float64)
        return (1.0 - blinks / CLOSED_SCORE).clip(0, 1)


def save_landmarks(path: Path, landmarks: Landmarks) -> None:
    """Write a .npz of plain arrays, whole or not at all. Raises UserError when the disk refuses."""
    arrays = {
        "points": landmarks.points.astype(np.float32),
        "scores": landmarks.scores.astype(np.float32),
        "detected": landmarks.detected.astype(bool),
        "size": np.array(landmarks.size, np.int64),
        "fps": np.array(landmarks.fps, np.float64),
    }
    save_npz(path, arrays)


def load_landmarks(path: Path) -> Landmarks:
    """Read what `save_landmarks` wrote. Raises UserError, naming the file, for anything else."""
    arrays = load_npz(path)

    def part(name: str, kinds: str, shape: tuple[int, ...]) -> np.ndarray:
        array = arrays.get(name)
        if array is None or array.dtype.kind not in kinds or array.shape != shape:
            given = "missing" if array is None else f"{array.dtype} {list(array.shape)}"
            raise UserError(
                f"{path} is not a file of landmarks: {name} is {given}, expected {list(shape)}; track again"
            )
        if array.dtype.kind == "f" and not (np.abs(array) <= np.finfo(np.float32).max).all():
            raise UserError(f"{path} is damaged: {name} holds values that are not finite; track again")
        return array

    T = min(len(arrays["detected"]), _MAX_FRAMES) if arrays.get("detected", np.zeros(())).ndim == 1 else 0
    width, height = part("size", "iu", (2,)).tolist()
    fps = float(part("fps", "f", ()))
    if min(width, height) < 1 or max(width, height) >= 2**16 or fps <= 0:
        raise UserError(f"{path} is damaged: frames of {width}x{height} pixels at {fps:g} per second; track again")
    return Landmarks(
        points=part("points", "f", (T, NUM_POINTS, 3)).astype(np.float32),
        scores=part("scores", "f", (T, len(BLENDSHAPES))).astype(np.float32),
        detected=part("detected", "b", (T,)),
        size=(width, height),
        fps=fps,
    )
