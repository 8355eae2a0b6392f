"""Decoding of image and mask files, with truncation found: decoders fill what is missing with grey and say nothing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from avatar.errors import UserError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_PNG_COLOUR_TYPE = 25  # its place in the header; 4 is grey and 6 is colour, with an alpha channel each
MAX_PIXELS = 2**26  # 8192x8192; a decoder allocates what the header says before it looks how much there is
_TAIL = 4096  # some writers pad after the end marker


def read_image(path: Path) -> np.ndarray:
    """uint8 [H, W, 3], red first. Raises UserError naming the file when it is missing, truncated or not an image."""
    return cv2.cvtColor(_decode(read_bytes(path), path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_mask(path: Path) -> np.ndarray:
    """uint8 [H, W]: the transparency of a PNG that has any, else the luminance. Raises UserError as `read_image` does."""
    return decode_mask(read_bytes(path), path)


def decode_image(data: bytes, path: Path) -> np.ndarray:
    """`read_image` of bytes that were read already; `path` is for the message."""
    return cv2.cvtColor(_decode(data, path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def decode_mask(data: bytes, path: Path) -> np.ndarray:
    """`read_mask` of bytes that were read already; `path` is for the message."""
    if has_transparency(data):
        channels = _decode(data, path, cv2.IMREAD_UNCHANGED)
        matte = channels[..., -1] if channels.ndim == 3 else channels
        if matte.dtype == np.uint8 and matte.min() < 255:
            return np.ascontiguousarray(matte)
    return _decode(data, path, cv2.IMREAD_GRAYSCALE)


def has_transparency(data: bytes) -> bool:
    """Whether the header is that of a PNG with an alpha channel."""
    return data.startswith(_PNG_START) and len(data) > _PNG_COLOUR_TYPE and data[_PNG_COLOUR_TYPE] in (4, 6)


def read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from None


def _decode(data: bytes, path: Path, flags: int) -> np.ndarray:
    if not data:
        raise UserError(f"{path} is empty; write or copy it again")
    if data.startswith(_JPEG_START):
        complete = _JPEG_END in data[-_TAIL:]
    elif data.startswith(_PNG_START):
        complete = _PNG_END in data[-_TAIL:]
    else:
        raise UserError(f"{path} is neither a JPEG nor a PNG file, whatever its name says")
    if not complete:
        raise UserError(f"{path} is cut short; write or copy it again")
    width, height = _declared_size(data)
    if width * height > MAX_PIXELS:
        raise UserError(f"{path} claims to have {width}x{height} pixels; images of more than {MAX_PIXELS} are not read")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:  # absurd dimensions in the header
        raise UserError(f"{path} cannot be decoded ({error.err})") from None
    if image is None:
        raise UserError(f"{path} is damaged and cannot be decoded; write or copy it again")
    return image


def _declared_size(data: bytes) -> tuple[int, int]:
    """The largest (width, height) in the headers of a PNG or JPEG; (0, 0) where there is none, which decoders refuse."""
    if data.startswith(_PNG_START):
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    largest = (0, 0)
    at = len(_JPEG_START) - 1
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            at += 1  # image data, or filling between segments
            continue
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of a frame
            size = int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
            largest = max(largest, size, key=lambda wh: wh[0] * wh[1])
        if marker == 0xDA:  # the image data begin, in which no marker but the end's means anything here
            break
        has_length = 0xC0 <= marker <= 0xFE and not 0xD0 <= marker <= 0xD9
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big") if has_length else 1
    return largest
