"""Footage whose pictures are turned by quarters, as a video that was filmed on its side has to be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import UInt8

from data_prep.track.footage.source import Box, Footage, Span, TimedPicture, View, common_fields

TURNS = (0, 90, 180, 270)  # degrees clockwise


@dataclass(frozen=True)
class Turned(Footage):
    """Views are of the turned pictures."""

    footage: Footage
    degrees: int  # of TURNS, not 0

    def read(
        self, view: View, span: Span, complain: Callable[[str], object], every: int | None = None
    ) -> Iterator[TimedPicture]:
        for picture in self.footage.read(self._before(view), span, complain, every):
            yield TimedPicture(picture.time, turn_image(picture.image, self.degrees))

    @cached_property
    def content_hash(self) -> str:
        return self.footage.content_hash

    def _before(self, view: View) -> View:
        """The same part of the pictures before they are turned."""
        x, y, width, height = view.box
        if self.degrees == 180:
            return View(Box(self.width - x - width, self.height - y - height, width, height), view.width, view.height)
        if self.degrees == 90:
            return View(Box(y, self.width - x - width, height, width), view.height, view.width)
        return View(Box(self.height - y - height, x, height, width), view.height, view.width)


def turned(footage: Footage, degrees: int) -> Footage:
    """The footage with its pictures turned clockwise by a multiple of 90 degrees."""
    if not degrees:
        return footage
    values = common_fields(footage)
    if degrees % 180:
        values |= {"width": footage.height, "height": footage.width}
    return Turned(**values, footage=footage, degrees=degrees)


def turn_image(image: UInt8[np.ndarray, "H W *C"], degrees: int) -> np.ndarray:
    """The image turned clockwise by a multiple of 90 degrees."""
    return np.ascontiguousarray(np.rot90(image, -(degrees // 90)))
