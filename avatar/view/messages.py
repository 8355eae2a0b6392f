"""Which messages of viser's protocol a page may send, and with which values: its camera, and the controls of the panel.

viser knows many more. Some do harm: one opens a tunnel through which everybody can reach the viewer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Annotated, Any

import msgspec

MAX_MESSAGE = 1 << 14  # bytes
FARTHEST = 1e6  # of a coordinate
MAX_WINDOW = 1 << 14  # pixels

Value = bool | float | str
Number = Annotated[float, msgspec.Meta(ge=-FARTHEST, le=FARTHEST)]  # neither infinite nor NaN
Vector = tuple[Number, Number, Number]


class MessageError(ValueError):
    """What is wrong with a message."""


class _Camera(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage", forbid_unknown_fields=True):
    wxyz: tuple[Number, Number, Number, Number]
    position: Vector
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number
    look_at: Vector
    up_direction: Vector


class _New(msgspec.Struct, forbid_unknown_fields=True):
    value: bool | float | Annotated[str, msgspec.Meta(max_length=1000)]


class _Change(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    uuid: Annotated[str, msgspec.Meta(max_length=64)]
    updates: _New


class MessageCheck:
    """Lets through what a page may send."""

    def __init__(self) -> None:
        self._checks: dict[str, Callable[[Value], Value]] = {}
        self._decoder = msgspec.msgpack.Decoder(_Camera | _Change)

    def allow(self, handle: Any, check: Callable[[Value], Value]) -> None:
        """A page may set this control of viser's to what `check` returns; it raises MessageError."""
        self._checks[handle._impl.uuid] = check  # there is no public name for it

    def passed(self, data: bytes | str) -> bytes:
        """The message with every value in its range. Raises MessageError."""
        if isinstance(data, str):
            raise MessageError("a message is text")
        try:
            message = self._decoder.decode(data)
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
            raise MessageError("a message is none of this viewer's page") from None
        if isinstance(message, _Camera):
            message.image_width, message.image_height = _pixels(message.image_width), _pixels(message.image_height)
        elif message.uuid not in self._checks:
            raise MessageError("a message names no control of the panel")
        else:
            message.updates.value = self._checks[message.uuid](message.updates.value)
        return msgspec.msgpack.encode(message)


def pressed(value: Value) -> Value:
    """The check of a button."""
    if value is not True:
        raise MessageError("a button is pressed or not")
    return value


def switched(value: Value) -> Value:
    """The check of a checkbox."""
    if not isinstance(value, bool):
        raise MessageError("a checkbox is on or off")
    return value


def one_of(options: Collection[str]) -> Callable[[Value], Value]:
    """The check of a list to choose from."""

    def check(value: Value) -> Value:
        if value not in options:
            raise MessageError("a choice is none of the list")
        return value

    return check


def within(low: float, high: float) -> Callable[[Value], Value]:
    """The check of a slider: beyond its ends it stays at them."""

    def check(value: Value) -> Value:
        if isinstance(value, bool | str) or not math.isfinite(value):
            raise MessageError("a slider's value is no number")
        return min(max(value, low), high)

    return check


def _pixels(size: float) -> int:
    return round(min(max(size, 1), MAX_WINDOW))
