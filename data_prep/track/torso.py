"""How the torso is turned against the head, from the clothes.

A neck that turned with the head would carry the collar along; a real collar stays with the shoulders. So the clothes of
every frame are aligned with those of one reference frame, after the shift and the size that the head's own motion
explains, by the enhanced correlation coefficient. What is left moves the base of the neck in the picture, and the torso
turns about the neck's joint until the base lies there. Where the clothes cannot be aligned, behind a hand say, the
neighbours in time stand in. A turn moves the base aside, hardly up and down: what breath and shrugs do stays.

Source of the alignment: Evangelidis and Psarakis, "Parametric image alignment using enhanced correlation coefficient
maximization" (2008), as in OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from scipy.ndimage import median_filter

from avatar.head.model import HeadModel, nearest_rotation
from data_prep.formats.frame_track import FrameTrack

SIDE = 256  # pixels of the longer side of the pictures that are aligned
_BLUR = 1.0  # pixels
_AROUND = 9  # pixels: the template reaches so far beyond the clothes, for their border
_EDGE = 6  # pixels at the picture's border, where clothes end that go on
_LEAST_CLOTHES = 0.01  # share of the reference picture
_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-4)
_ALIGNED = 0.7  # correlation from which on an alignment is believed
_FARTHEST = 0.35  # radians that a torso turns from where it is on average
_MEDIAN = 5  # frames
LEAST_FOLLOWED = 0.5  # share of the frames; with less the torso stays with the head


class Picture(NamedTuple):
    image: UInt8[np.ndarray, "H W 3"]
    matte: UInt8[np.ndarray, "H W"]
    head: UInt8[np.ndarray, "H W"]  # the mask of head and neck


class Clothes(NamedTuple):
    grey: Float32[np.ndarray, "h w"]
    share: Float32[np.ndarray, "h w"]


class Neck(NamedTuple):
    """Of the head model: where the neck is hung, and where it ends."""

    joint: Float[np.ndarray, "3"]
    arm: Float[np.ndarray, "3"]  # from there to the middle of the ring at its base, metres


def neck_of(model: HeadModel, ring: np.ndarray) -> Neck:
    joint = model.neck()[0].double().numpy()
    return Neck(joint, model.neutral_vertices()[ring].double().numpy().mean(axis=0) - joint)


class TorsoTracker:
    """Aligns the clothes of a clip's frames with those of its `reference`; `mean` is the head's mean orientation before the
    camera, which the torso has where it does not turn."""

    def __init__(self, tracks: dict[int, FrameTrack], neck: Neck, picture: Callable[[int], Picture]) -> None:
        self._tracks, self._neck, self._picture = tracks, neck, picture
        first = next(iter(tracks.values()))
        self._scale = SIDE / max(first.size)
        width, height = first.size
        self.size = max(1, round(width * self._scale)), max(1, round(height * self._scale))
        self.mean = nearest_rotation(torch.from_numpy(np.mean([track.R for track in tracks.values()], axis=0))).numpy()
        self.reference = self._typical_frame()
        self._place = self._base(self.reference)
        clothes = self._clothes(self.reference)
        dark = float((clothes.grey * clothes.share).sum()) < 128 * float(clothes.share.sum())
        self._beyond = 200.0 if dark else 50.0  # grey of what is no clothes
        self._template = self._drawn(clothes)
        reach = cv2.dilate((clothes.share > 0.5).astype(np.uint8), np.ones((_AROUND, _AROUND), np.uint8))
        reach[-_EDGE:], reach[:, :_EDGE], reach[:, -_EDGE:] = 0, 0, 0
        self._reach = reach
        self.has_clothes = float((clothes.share > 0.5).mean()) >= _LEAST_CLOTHES

    def _typical_frame(self) -> int:
        tracks = list(self._tracks.items())
        turns = np.array([np.linalg.norm(track.R - self.mean) for _, track in tracks])
        shifts = np.stack([track.t for _, track in tracks])
        shifts = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
        away = sum(values / max(float(np.median(values)), 1e-9) for values in (turns, shifts))
        return tracks[int(np.argmin(away))][0]

    def _base(self, number: int) -> tuple[Float[np.ndarray, "2"], float]:
        """Where the neck's base is if the torso keeps its mean orientation: pixels of the small picture, depth."""
        track = self._tracks[number]
        point = track.R @ self._neck.joint + track.t + self.mean @ self._neck.arm
        fx, fy, cx, cy = track.intrinsics * self._scale
        return np.array([fx * point[0] / point[2] + cx, fy * point[1] / point[2] + cy]), float(point[2])

    def _clothes(self, number: int) -> Clothes:
        picture = self._picture(number)
        image, matte, head = (cv2.resize(part, self.size, interpolation=cv2.INTER_AREA) for part in picture)
        share = matte.astype(np.float32) / 255.0 * (1.0 - head.astype(np.float32) / 255.0)
        return Clothes(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), share)

    def _drawn(self, clothes: Clothes) -> Float32[np.ndarray, "h w"]:
        """The clothes alone."""
        drawn = clothes.grey * clothes.share + self._beyond * (1.0 - clothes.share)
        return cv2.GaussianBlur(drawn, (0, 0), _BLUR)

    def shift(self, number: int) -> Float[np.ndarray, "2"] | None:
        """By how much the neck's base is beside where the head alone would have it: pixels of the small picture."""
        (place, depth), (own, own_depth) = self._place, self._base(number)
        size = own_depth / depth
        place, own = place - 0.5, own - 0.5  # OpenCV's centres of pixels lie at whole numbers
        to_reference = np.array([[size, 0.0, place[0] - size * own[0]], [0.0, size, place[1] - size * own[1]]])
        drawn = self._drawn(self._clothes(number))
        drawn = cv2.warpAffine(drawn, to_reference, self.size, borderMode=cv2.BORDER_REPLICATE)
        warp = np.eye(2, 3, dtype=np.float32)
        try:
            _, warp = cv2.findTransformECC(self._template, drawn, warp, cv2.MOTION_TRANSLATION, _STEPS, self._reach, 5)
            found, warp = cv2.findTransformECC(
                self._template, drawn, warp, cv2.MOTION_EUCLIDEAN, _STEPS, self._reach, 5
            )
        except cv2.error:  # it has not converged
            return None
        return (warp @ np.append(place, 1.0) - place) / size if found >= _ALIGNED else None

    def turn(self, number: int, shift: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3 3"]:
        """The torso's orientation before the camera, for a shift of the neck's base in the small picture."""
        track = self._tracks[number]
        joint, arm = track.R @ self._neck.joint + track.t, self.mean @ self._neck.arm
        (x, y), _ = self._base(number)
        fx, fy, cx, cy = track.intrinsics * self._scale
        ray = np.array([(x + shift[0] - cx) / fx, (y + shift[1] - cy) / fy, 1.0])
        ray /= np.linalg.norm(ray)
        aim = ray * ((joint + arm) @ ray) - joint  # the ray's nearest point to where the base was
        return _between(arm, aim) @ self.mean


def with_torso(
    tracks: dict[int, FrameTrack], tracker: TorsoTracker, shifts: Iterable[Float[np.ndarray, "2"] | None]
) -> dict[int, FrameTrack]:
    """The tracks with the neck's turns for these shifts of all frames; None is filled in. The same where all are None."""
    known = {row: shift for row, shift in enumerate(shifts) if shift is not None}
    if not known:
        return tracks
    numbers = np.array(list(tracks))
    columns = np.stack(list(known.values()), axis=1)
    every = np.stack([np.interp(numbers, numbers[list(known)], column) for column in columns], axis=1)
    every = median_filter(every, size=(_MEDIAN, 1), mode="nearest")
    found = {}
    for (number, track), shift in zip(tracks.items(), every, strict=True):
        neck = tracker.turn(number, shift).T @ track.R
        found[number] = replace(track, neck=neck[:2].ravel())
    return found


def _between(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The shortest turn from one direction to another, by `_FARTHEST` at most."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, start @ end)
    return cv2.Rodrigues(axis / max(sine, 1e-12) * min(angle, _FARTHEST))[0]
