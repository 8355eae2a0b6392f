"""Instructions while a person is filmed: what to do, what is wrong with the picture, and how much is done."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from data_prep.track.faces.detect import Face
from data_prep.track.faces.landmarks import BLENDSHAPES

# Of the picture, for `problem`.
LEAST_HEIGHT = 200.0  # pixels, of the face
DARK = 100.0  # grey level that a tenth of the face exceeds; skin of every colour has highlights
WHITE, MOST_WHITE = 250, 0.15  # grey level, and the share of the face that may have it
LEAST_SHARP, SHARP_SHARE = 0.015, 0.3  # of `sharpness`: in focus, and of the sharpest pictures so far
PATIENCE = 0.5  # seconds that something is wrong before it is said
MARGINS = (-0.15, -0.3, 0.15, 0.1)  # heights of the face, from its left, top, right and bottom to the head's
# Of the range, for `reaches`.
HELD = 0.5  # seconds
GRACE = 1.0  # seconds after a prompt that still count
_SIDE = 128  # pixels, of the face that sharpness is measured on
_LEFT, _RIGHT, _FOREHEAD, _CHIN = 454, 234, 10, 152  # landmarks: before the person's ears, and the face's ends


class Prompt(NamedTuple):
    words: str
    seconds: float
    least: Mapping[str, float]  # by names of `measures`: beyond the calm face


PROMPTS = (
    Prompt("Look at the camera calmly, lips closed.", 5, {}),
    Prompt("Say a sentence, then open the mouth wide.", 8, {"mouth open": 0.3}),
    Prompt("Smile, with closed lips, then with teeth.", 5, {"smile": 0.4}),
    Prompt("Raise the brows.", 4, {"brows raised": 0.25}),
    Prompt("Close the eyes until the next prompt.", 4, {"lids closed": 0.3}),
    Prompt("Head still: look with the eyes to the left, right.", 5, {"eyes left": 0.25, "eyes right": 0.25}),
    Prompt("Head still: look with the eyes up, down.", 5, {"eyes up": 0.1, "eyes down": 0.25}),
    Prompt("Turn the head slowly to the left, and back.", 5, {"degrees left": 25}),
    Prompt("Turn the head slowly to the right, and back.", 5, {"degrees right": 25}),
    Prompt("Lift the head slowly, and lower it.", 5, {"degrees up": 10, "degrees down": 10}),
    Prompt("Speak freely, and move as you do.", 9, {"mouth open": 0.15}),
)
ENDS = np.cumsum([prompt.seconds for prompt in PROMPTS]).tolist()  # seconds of the film


def measures(face: Face) -> dict[str, float]:
    """Blendshape scores 0 to 1, and angles of the head in degrees; left is the person's."""

    def mean(*names: str) -> float:
        return float(np.mean([face.scores[BLENDSHAPES.index(name)] for name in names]))

    across, down = face.points[_LEFT] - face.points[_RIGHT], face.points[_CHIN] - face.points[_FOREHEAD]
    yaw, pitch = (math.degrees(math.atan2(z, along)) for z, along in ((across[2], across[0]), (down[2], down[1])))
    return {
        "mouth open": mean("jawOpen"),
        "smile": mean("mouthSmileLeft", "mouthSmileRight"),
        "brows raised": mean("browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
        "lids closed": mean("eyeBlinkLeft", "eyeBlinkRight"),
        "eyes left": mean("eyeLookOutLeft", "eyeLookInRight"),
        "eyes right": mean("eyeLookInLeft", "eyeLookOutRight"),
        "eyes up": mean("eyeLookUpLeft", "eyeLookUpRight"),
        "eyes down": mean("eyeLookDownLeft", "eyeLookDownRight"),
        "degrees left": yaw,
        "degrees right": -yaw,
        "degrees up": -pitch,
        "degrees down": pitch,
    }


class Seen(NamedTuple):
    time: float  # seconds of the film
    values: dict[str, float]  # of `measures`


def reaches(seen: Sequence[Seen]) -> list[dict[str, float] | None]:
    """For each prompt, what was held for `HELD` seconds beyond the median of the calm face; None where no face was seen."""
    calm = [one.values for one in seen if one.time < ENDS[0]]
    rest = {name: float(np.median([values[name] for values in calm])) for name in (calm[0] if calm else ())}
    found: list[dict[str, float] | None] = []
    for prompt, end in zip(PROMPTS, ENDS, strict=True):
        during = [one.values for one in seen if end - prompt.seconds <= one.time < end + GRACE]
        share = 1 - HELD / (prompt.seconds + GRACE)
        reached = {
            name: float(np.quantile([values[name] for values in during], share)) - rest.get(name, 0.0)
            for name in (prompt.least if during else ())
        }
        found.append(reached if during else None)
    return found


class RecordingAdvice:
    """The one thing that is wrong with the pictures, once it has been so for `PATIENCE` seconds."""

    def __init__(self) -> None:
        self._sharp: list[float] = []
        self._wrong, self._since = "", 0.0

    def advise(self, image: UInt8[np.ndarray, "H W 3"], face: Face | None, time: float) -> str:
        """Of the picture at this second; empty where nothing is wrong."""
        wrong = self.problem(image, face)
        if wrong != self._wrong:
            self._wrong, self._since = wrong, time
        return wrong if time - self._since >= PATIENCE else ""

    def problem(self, image: UInt8[np.ndarray, "H W 3"], face: Face | None) -> str:
        if face is None:
            return "no face: look into the camera"
        size, tall = np.array(image.shape[1::-1]), face.height
        box = np.array(face.box) + tall * np.array(MARGINS)
        if tall < LEAST_HEIGHT:
            return "come closer"
        if (box[2:] - box[:2] > size).any():
            return "go back a little"
        if box.min() < 0 or (box[2:] > size).any():
            return "move to the middle"
        left, top, right, bottom = (int(value) for value in face.box)
        grey = cv2.cvtColor(np.ascontiguousarray(image[top:bottom, left:right]), cv2.COLOR_RGB2GRAY)
        if np.percentile(grey, 90) < DARK:
            return "more light on the face"
        if (grey >= WHITE).mean() > MOST_WHITE:
            return "less light on the face"
        self._sharp.append(sharp := sharpness(grey))
        if sharp < SHARP_SHARE * float(np.quantile(self._sharp, 0.9)):
            return "hold still"
        return "focus the camera, or wipe its lens" if sharp < LEAST_SHARP else ""


def sharpness(grey: UInt8[np.ndarray, "H W"]) -> float:
    """Variance of the Laplacian over the variance, of a face brought to one height: neither size nor light count."""
    scale = _SIDE / grey.shape[0]
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    return float(cv2.Laplacian(small, cv2.CV_32F).var() / max(float(small.var()), 1.0))
