"""Packets as phones and other programs send them to a stream."""

from __future__ import annotations

import struct

from pythonosc.osc_message_builder import OscMessageBuilder

from avatar.view.packets import LIVE_LINK


def live_link(values: dict[str, float], subject: bytes = b"phone") -> bytes:
    device = b"01234567-89ab-cdef-0123-456789abcdef"
    floats = [values.get(name, 0.0) for name in LIVE_LINK]
    head = b"\x06" + struct.pack(">i", len(device)) + device + struct.pack(">i", len(subject)) + subject
    return head + struct.pack(">ifii", 7, 0.5, 60, 1) + struct.pack(">B61f", 61, *floats)


def osc(address: str, *values: object) -> bytes:
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)  # type: ignore[arg-type]
    return builder.build().dgram


def bundle(*parts: bytes) -> bytes:
    return b"#bundle\0" + bytes(8) + b"".join(struct.pack(">i", len(part)) + part for part in parts)
