"""Expression frames as they come over a socket: JSON, OSC messages, Live Link Face's packets. All of it is foreign input.

JSON, one object a line: `expression` (a list of coefficients, or an object of names or numbers), `jaw` [3], `eyes` [6],
`eyelids` [2] as in drive files (docs/reenact.md), or `blendshapes`, an object of ARKit's names and their values.

OSC over UDP: /VMC/Ext/Blend/Val NAME VALUE and /VMC/Ext/Blend/Apply (the VMC protocol), or an address that ends in the name
of one of ARKit's blendshapes, with its value. What is not sent keeps its value.

Live Link Face over UDP (version 6): device and subject, a frame's time, and 61 values in the order of Unreal's
EARFaceBlendShape. The app's CSV files, whose columns have names, put right before left of jaw and mouth.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

from avatar.head.assets import HeadAssets
from avatar.head.expression_names import plain
from avatar.motion.drive_csv import from_blendshapes
from avatar.motion.drive_file import LARGEST
from avatar.types import IDENTITY_6D, HeadParams

MAX_LINE = 1 << 16  # bytes
LIVE_LINK_VERSION = 6
SIDED_EYE = ("EyeBlink", "EyeLookDown", "EyeLookIn", "EyeLookOut", "EyeLookUp", "EyeSquint", "EyeWide")
LIVE_LINK = (
    *(f"{name}Left" for name in SIDED_EYE),
    *(f"{name}Right" for name in SIDED_EYE),
    *("JawForward", "JawLeft", "JawRight", "JawOpen", "MouthClose", "MouthFunnel", "MouthPucker", "MouthLeft"),
    *("MouthRight", "MouthSmileLeft", "MouthSmileRight", "MouthFrownLeft", "MouthFrownRight", "MouthDimpleLeft"),
    *("MouthDimpleRight", "MouthStretchLeft", "MouthStretchRight", "MouthRollLower", "MouthRollUpper"),
    *("MouthShrugLower", "MouthShrugUpper", "MouthPressLeft", "MouthPressRight", "MouthLowerDownLeft"),
    *("MouthLowerDownRight", "MouthUpperUpLeft", "MouthUpperUpRight", "BrowDownLeft", "BrowDownRight"),
    *("BrowInnerUp", "BrowOuterUpLeft", "BrowOuterUpRight", "CheekPuff", "CheekSquintLeft", "CheekSquintRight"),
    *("NoseSneerLeft", "NoseSneerRight", "TongueOut", "HeadYaw", "HeadPitch", "HeadRoll", "LeftEyeYaw"),
    *("LeftEyePitch", "LeftEyeRoll", "RightEyeYaw", "RightEyePitch", "RightEyeRoll"),
)
BLENDSHAPES = LIVE_LINK[: LIVE_LINK.index("TongueOut") + 1]  # without the head's and the eyes' angles
_SHAPES = frozenset(plain(name) for name in LIVE_LINK)


BUNDLE, BUNDLE_HEAD, MAX_NESTING = b"#bundle\0", 16, 4
# What the reader of OSC gets: it prints what it does not know, and cannot end with some damaged bundles.
_OSC = re.compile(rb"(/[^\0]{1,200})\0+,[ifsdhTF]{0,2}\0.*", re.DOTALL)


class PacketError(ValueError):
    """What is wrong with a packet. What the sender has written is in it only as Python's ascii() gives it."""


class FrameReader:
    """Packets into frames of one head model."""

    def __init__(self, assets: HeadAssets) -> None:
        self._assets = assets
        self._shapes: dict[str, float] = {}  # what OSC has said so far

    def line(self, data: bytes) -> tuple[HeadParams, bool]:
        """A line of JSON; True where its expressions depart from a neutral face by themselves. Raises PacketError."""
        try:
            found = json.loads(data)
        except (ValueError, RecursionError):
            raise PacketError("a line is not JSON") from None
        if not isinstance(found, dict):
            raise PacketError("a line is not a JSON object")
        if "blendshapes" in found:
            return self._from_shapes(_shape_values(found["blendshapes"])), True
        if "expression" not in found:
            raise PacketError("a line has neither expression nor blendshapes")
        arrays = {"expression": self._coefficients(found["expression"])}
        for name, count in (("jaw", 3), ("eyes", 6), ("eyelids", 2)):
            arrays[name] = _numbers(found[name], count, name) if name in found else np.zeros(count)
        return _params(arrays), False

    def datagram(self, data: bytes) -> HeadParams | None:
        """A UDP packet of either kind; None where it does not complete a frame. Raises PacketError."""
        if data[:1] == bytes([LIVE_LINK_VERSION]):
            return self._from_shapes(live_link_values(data))
        return self._osc(data)

    def _osc(self, data: bytes) -> HeadParams | None:
        from pythonosc.osc_message import OscMessage

        try:
            messages = [OscMessage(part) for part in osc_messages(data) if _OSC.fullmatch(part)]
        except PacketError:
            raise
        except Exception as error:  # the library raises what its parts raise; it reads bytes, and does nothing else
            raise PacketError("a packet is neither OSC nor of Live Link Face") from error
        is_complete, has_apply = False, False
        for message in messages:
            words, address = list(message.params), message.address
            if address == "/VMC/Ext/Blend/Apply":
                is_complete = True
            elif address == "/VMC/Ext/Blend/Val" and len(words) == 2 and isinstance(words[0], str):
                self._take(words[0], words[1])
                has_apply = True
            elif plain(name := address.rpartition("/")[2]) in _SHAPES and len(words) == 1:
                self._take(name, words[0])
                is_complete = True
        if not is_complete and not has_apply:
            raise PacketError("an OSC packet names no blendshape")
        return self._from_shapes(self._shapes) if is_complete else None

    def _take(self, name: str, value: Any) -> None:
        """Other names are left unread, so that a sender cannot fill the memory with them."""
        if plain(name) in _SHAPES:
            self._shapes[plain(name)] = _number(value, name)

    def _coefficients(self, values: Any) -> np.ndarray:
        E = self._assets.num_expressions
        expression = np.zeros(E)
        if isinstance(values, dict):
            for name, value in values.items():
                index = self._assets.names.index(name)
                if index is None and name.isascii() and name.isdigit() and len(name) < 7:
                    index = int(name)
                if index is None or index >= E:
                    raise PacketError(f"there is no expression {name[:40]!a}")
                expression[index] = _number(value, name)
        elif isinstance(values, list) and len(values) <= E:
            expression[: len(values)] = _numbers(values, len(values), "expression")
        else:
            raise PacketError(f"expression is neither an object nor a list of at most {E} numbers")
        return expression

    def _from_shapes(self, values: Mapping[str, float]) -> HeadParams:
        arrays, _ = from_blendshapes(
            {name: np.array([value]) for name, value in values.items()},
            1,
            self._assets.num_expressions,
            self._assets.names,
        )
        return _params({name: array[0] for name, array in arrays.items()})


def osc_messages(data: bytes, nesting: int = 0) -> Iterator[bytes]:
    """The messages of an OSC packet: its own, or those of its bundle. Raises PacketError."""
    if not data.startswith(BUNDLE):
        if not data.startswith(b"/"):
            raise PacketError("a packet is neither OSC nor of Live Link Face")
        yield data
        return
    at = BUNDLE_HEAD  # with the time
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        part = data[at + 4 : at + 4 + size]
        if len(part) != size or nesting == MAX_NESTING:
            raise PacketError("a bundle of OSC is damaged")
        yield from osc_messages(part, nesting + 1)
        at += 4 + size


def live_link_values(data: bytes) -> dict[str, float]:
    """Values by plain name of a packet of Live Link Face. Raises PacketError."""
    try:
        at = 1
        for _ in range(2):  # device, subject
            (length,) = struct.unpack_from(">i", data, at)
            if not 0 <= length <= len(data):
                raise PacketError("a packet of Live Link Face is damaged")
            at += 4 + length
        (count,) = struct.unpack_from(">B", data, at + 16)
        if count != len(LIVE_LINK) or len(data) != at + 17 + 4 * count:
            raise PacketError(f"a packet of Live Link Face has not {len(LIVE_LINK)} values")
        values = struct.unpack_from(f">{count}f", data, at + 17)
    except struct.error:
        raise PacketError("a packet of Live Link Face is cut short") from None
    return {plain(name): _number(value, name) for name, value in zip(LIVE_LINK, values, strict=True)}


def _shape_values(given: Any) -> dict[str, float]:
    if not isinstance(given, dict):
        raise PacketError("blendshapes is not an object")
    return {plain(name): _number(value, name) for name, value in given.items() if plain(name) in _SHAPES}


def _params(arrays: Mapping[str, np.ndarray]) -> HeadParams:
    def rotations(name: str) -> torch.Tensor:
        vectors = torch.from_numpy(arrays[name]).reshape(-1, 3)
        return axis_angle_to_rotation_matrix(vectors)[:, :2].reshape(-1).float()

    expression, eyelids = (torch.from_numpy(arrays[name]).float() for name in ("expression", "eyelids"))
    return HeadParams(expression, rotations("jaw"), rotations("eyes"), eyelids, torch.tensor(IDENTITY_6D))


def _numbers(values: Any, count: int, name: str) -> np.ndarray:
    if not isinstance(values, list) or len(values) != count:
        raise PacketError(f"{name} is not a list of {count} numbers")
    return np.array([_number(value, name) for value in values])


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise PacketError(f"{_shown(name)} is not a number")
    if isinstance(value, int):
        value = max(min(value, 10**6), -(10**6))  # refused below, without overflow
    if not math.isfinite(value) or abs(value) > LARGEST:
        raise PacketError(f"{_shown(name)} is not within +-{LARGEST:g}")
    return float(value)


def _shown(name: str) -> str:
    """A name that a sender may have written."""
    return name if re.fullmatch(r"[A-Za-z0-9_]{1,40}", name) else f"{name[:40]!a}"
