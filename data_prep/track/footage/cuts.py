"""Cuts of a film: places where a picture has nothing to do with the one before."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

THUMBNAIL = (48, 48)  # pixels; detail does not tell one shot from another, and moves
_MIN_CHANGE = 0.06  # of the range of grey; a talking head at 25 frames a second stays below 0.03
_TIMES_USUAL = 4.0  # the changes around it
_NEIGHBOURS = 12  # pictures on either side


class Shot(NamedTuple):
    """Pictures from `start` up to and without `end`."""

    start: int
    end: int

    @property
    def length(self) -> int:
        return self.end - self.start


class CutFinder:
    """Takes the pictures one by one and keeps a number for each."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._changes: list[float] = []

    def add(self, image: UInt8[np.ndarray, "H W 3"]) -> bool:
        """Whether the picture may begin a shot: it is much unlike the one before."""
        small = cv2.resize(image, THUMBNAIL, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
        self._changes.append(0.0 if self._last is None else float(np.abs(grey - self._last).mean()))
        self._last = grey
        return self._changes[-1] > _MIN_CHANGE

    def shots(self) -> list[Shot]:
        """The shots in their order; one where nothing is cut. A change counts as a cut when it is large and sudden."""
        changes = np.array(self._changes)
        starts = [0]
        for n in np.flatnonzero(changes > _MIN_CHANGE):
            around = np.r_[changes[max(1, n - _NEIGHBOURS) : n], changes[n + 1 : n + 1 + _NEIGHBOURS]]
            if len(around) == 0 or changes[n] > _TIMES_USUAL * np.median(around):
                starts.append(int(n))
        ends = [*starts[1:], len(changes)]
        return [Shot(*both) for both in zip(starts, ends, strict=True) if both[1] > both[0]]
