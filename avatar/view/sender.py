"""`avatar send`: a drive file's frames to a viewer's stream, at their own rate."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable

from kornia.geometry.conversions import rotation_matrix_to_axis_angle

from avatar.errors import UserError
from avatar.head.model import matrix_from_6d
from avatar.motion.drive import Drive
from avatar.types import HeadParams

DIGITS = 6


def encode_line(params: HeadParams) -> bytes:
    """A frame as the receiver reads it."""
    jaw = rotation_matrix_to_axis_angle(matrix_from_6d(params.jaw)[None])[0]
    eyes = rotation_matrix_to_axis_angle(matrix_from_6d(params.eyes.reshape(2, 6))).reshape(-1)
    arrays = {"expression": params.expression, "jaw": jaw, "eyes": eyes, "eyelids": params.eyelids}
    values = {name: [round(value, DIGITS) for value in array.tolist()] for name, array in arrays.items()}
    return json.dumps(values, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def send(
    drive: Drive,
    host: str,
    port: int,
    wait: Callable[[float], None] = time.sleep,
    token: str | None = None,
) -> int:
    """The number of frames sent. Raises UserError when nobody listens, or stops to."""
    sent, begin = 0, time.monotonic()
    try:
        with socket.create_connection((host, port), timeout=10) as connection:
            if token is not None:
                connection.sendall(json.dumps({"token": token}, allow_nan=False).encode() + b"\n")
            for params in drive.params:
                wait(max(begin + sent / drive.fps - time.monotonic(), 0.0))
                connection.sendall(encode_line(params))
                sent += 1
    except (OSError, OverflowError) as error:
        raise UserError(
            f"{sent} frames sent; {host}:{port} does not take any more ({error}): does avatar view --stream {port} run, "
            "and did it print this --token?"
        ) from None
    return sent
