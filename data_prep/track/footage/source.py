"""What is tracked: a video or a folder of pictures, as upright pictures of square pixels with their times."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import UInt8

from avatar.errors import UserError

MAX_SIDE = 8192  # pixels of a source picture
MIN_SIDE = 64
MAX_RATE = 32.0  # pictures a second that are used: more hardly differ from their neighbours and cost as much
BEHIND_TRANSPARENT = 127  # grey level
LAID_OVER_GREY = "the pictures are transparent in parts: they are laid over grey"


class Box(NamedTuple):
    """A rectangle of whole pixels."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class View:
    """Which part of the upright pictures is read, and at which size."""

    box: Box
    width: int
    height: int

    def to_view(self, x: float, y: float) -> tuple[float, float]:
        """A point of the upright picture (pixel centres at +0.5) in this view's pixels."""
        return (x - self.box.x) * self.width / self.box.width, (y - self.box.y) * self.height / self.box.height


class Span(NamedTuple):
    """Seconds from the beginning of the footage; to the end of it where `end` is None."""

    start: float = 0.0
    end: float | None = None


class TimedPicture(NamedTuple):
    time: float  # seconds from the beginning of the footage
    image: UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class Footage(ABC):
    """A source of pictures that can be read several times, each time the same ones."""

    is_joined: ClassVar[bool] = False  # of several takes of a camera that stands still, with gaps of whole pictures

    path: Path
    width: int
    height: int
    rate: float | None  # pictures a second, as the file says, before `stride`
    duration: float | None  # seconds, as the file says
    equivalent_focal: float | None  # millimetres for film of 36x24 mm, from the metadata
    notes: tuple[str, ...]

    @abstractmethod
    def read(
        self, view: View, span: Span, complain: Callable[[str], object], every: int | None = None
    ) -> Iterator[TimedPicture]:
        """The pictures in the order of their times, each `every`-th (None: `stride`); `complain` hears at the end what was
        wrong with them."""

    @cached_property
    @abstractmethod
    def content_hash(self) -> str:
        """SHA-256 of all that is read."""


def common_fields(footage: Footage) -> dict[str, Any]:
    """What every Footage has, for one that wraps this one."""
    return {field.name: getattr(footage, field.name) for field in fields(Footage)}


def stride(rate: float | None) -> int:
    """Every how manieth picture is used."""
    return 1 if rate is None else max(1, math.ceil(rate / MAX_RATE - 1e-9))


def whole(width: int, height: int, longest: int | None = None) -> View:
    """The whole picture, made smaller where its longer side has more than `longest` pixels."""
    scale = 1.0 if longest is None else min(1.0, longest / max(width, height))
    return View(Box(0, 0, width, height), max(1, round(width * scale)), max(1, round(height * scale)))


def check_size(path: Path, width: int, height: int) -> None:
    if min(width, height) < MIN_SIDE:
        raise UserError(f"{path} has pictures of {width}x{height} pixels; a face needs {MIN_SIDE} at least")
    if max(width, height) > MAX_SIDE:
        raise UserError(f"{path} has pictures of {width}x{height} pixels; more than {MAX_SIDE} a side are not read")


def check_span(span: Span, duration: float | None) -> None:
    """Raises UserError for times that are not in the footage."""
    start, end = span
    if not (math.isfinite(start) and start >= 0):
        raise UserError(f"--start must be a time in seconds from 0 on, not {start}")
    if end is not None and not (math.isfinite(end) and end > start):
        raise UserError(f"--end must be a time in seconds after --start ({start:g}), not {end}")
    if duration is not None and start >= duration:
        raise UserError(f"--start {start:g} is behind the end of the video, which is {duration:.2f} s long")


def opaque(pixels: UInt8[np.ndarray, "H W 4"]) -> UInt8[np.ndarray, "H W 3"]:
    """A picture with transparency over grey."""
    alpha = pixels[..., 3:]
    if alpha.min() == 255:
        return np.ascontiguousarray(pixels[..., :3])
    weight = alpha.astype(np.uint16)
    over = pixels[..., :3] * weight + BEHIND_TRANSPARENT * (255 - weight) + 127
    return (over // 255).astype(np.uint8)
