"""Decoding of image and mask files, with truncation found: decoders fill what is missing with grey and say nothing.

The foreground matte of an image is a mask file, or the image itself: then its transparency is meant (`read_matte`).
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from avatar.errors import UserError
from avatar.files.read import read_bytes as read_bounded

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
OTHER_PICTURES = (".webp", ".bmp", ".tif", ".tiff", ".gif", ".heic", ".avif", ".jp2", ".ppm", ".exr", ".tga", ".jxl")
_JPEG_START, _JPEG_TABLES, _JPEG_SCAN, _JPEG_END = b"\xff\xd8\xff", 0xC4, 0xDA, b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_PNG_COLOUR_TYPE = 25  # its place in the header; 4 is grey and 6 is colour, with an alpha channel each
_PALETTE = 3  # the colour type of a PNG that holds indices into a palette
_ORIENTATION = 0x0112  # EXIF 2.3
EVERY_LABEL = 0  # as a label: every value but 0 is the person
MAX_PIXELS = 2**26  # 8192x8192; a decoder allocates what the header says before it looks how much there is
MAX_BYTES = 2**28  # of a file
_STARTS = {  # of pictures that are not read: where, what, the format
    "WebP": (8, b"WEBP"), "BMP": (0, b"BM"), "TIFF": (0, b"II*\0"), "big-endian TIFF": (0, b"MM\0*"), "GIF": (0, b"GIF8"),
    "HEIC": (4, b"ftyphei"), "AVIF": (4, b"ftypavi"),
}  # fmt: skip
_LEAST_ZEROS = 256  # bytes; a few blocks may hold some
_TAIL = 4096  # some writers pad after the end marker


def read_image(path: Path) -> np.ndarray:
    """uint8 [H, W, 3], red first. Raises UserError naming the file when it is missing, truncated or not an image."""
    return cv2.cvtColor(_decode(read_bytes(path), path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_mask(path: Path, label: int | None = None) -> np.ndarray:
    """uint8 [H, W], 0 to 255; see `decode_mask`. Raises UserError as `read_image` does."""
    return decode_mask(read_bytes(path), path, label)


def read_matte(path: Path, image: Path, label: int | None = None) -> np.ndarray:
    """uint8 [H, W], 255 where `image` shows the person: the mask file `path`, or the transparency of the image itself.

    Raises UserError as `read_image` does.
    """
    return decode_transparency(read_bytes(path), path) if path == image else read_mask(path, label)


def decode_image(data: bytes, path: Path) -> np.ndarray:
    """`read_image` of bytes that were read already; `path` is for the message."""
    return cv2.cvtColor(_decode(data, path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def decode_mask(data: bytes, path: Path, label: int | None = None) -> np.ndarray:
    """uint8 [H, W], 0 to 255: the values of a mask file that was read already; `path` is for the message.

    With a `label`, the file is a label image that holds 0 and this value, which becomes 255, as others do with EVERY_LABEL;
    else it raises UserError for these.
    """
    values = decode_values(data, path)
    if label is None:
        return values
    is_person = values != 0 if label == EVERY_LABEL else values == label
    strange = values[~is_person & (values != 0)]
    if len(strange):
        raise UserError(f"{path} holds the value {strange[0]} beside 0 and {label}; make all masks alike")
    return np.where(is_person, np.uint8(255), np.uint8(0))


def decode_values(data: bytes, path: Path) -> np.ndarray:
    """uint8 [H, W] that a mask file holds: its transparency if there is any, the indices of a coloured palette, the
    values of a 16-bit file that needs only 8 of them, else its luminance. Raises UserError as `read_image` does."""
    matte = _transparency(data, path)
    if matte is not None and matte.min() < 255:
        return matte
    values = _decode(data, path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if values.dtype == np.uint16:
        return _of_16_bits(values) if values.max() > 255 else values.astype(np.uint8)
    indices = _palette_indices(data, path)
    return values if indices is None else indices


def decode_transparency(data: bytes, path: Path) -> np.ndarray:
    """uint8 [H, W]: an image's own transparency, 255 where it has none. Raises UserError as `read_image` does."""
    matte = _transparency(data, path)
    return np.full(_decode(data, path, cv2.IMREAD_GRAYSCALE).shape, 255, np.uint8) if matte is None else matte


def has_transparency(data: bytes) -> bool:
    """Whether the header is that of a PNG with an alpha channel, or with transparent colours."""
    if not data.startswith(_PNG_START) or len(data) <= _PNG_COLOUR_TYPE:
        return False
    return data[_PNG_COLOUR_TYPE] in (4, 6) or b"tRNS" in data[: max(data.find(b"IDAT"), 0)]


def _transparency(data: bytes, path: Path) -> np.ndarray | None:
    if not has_transparency(data):
        return None
    channels = _decode(data, path, cv2.IMREAD_UNCHANGED)
    if channels.ndim != 3 or channels.shape[2] != 4:  # the decoder has no place for a transparent grey
        return None
    matte = _upright(channels[..., 3], data)
    return np.ascontiguousarray(_of_16_bits(matte) if matte.dtype == np.uint16 else matte, np.uint8)


def _of_16_bits(values: np.ndarray) -> np.ndarray:
    return (values.astype(np.float32) / 257).round().astype(np.uint8)  # 65535 is 257 x 255


def _palette_indices(data: bytes, path: Path) -> np.ndarray | None:
    """uint8 [H, W] of a PNG with a palette of colours, whose luminance says nothing; None for others and for greys."""
    if not data.startswith(_PNG_START) or data[_PNG_COLOUR_TYPE : _PNG_COLOUR_TYPE + 1] != bytes([_PALETTE]):
        return None
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            palette = np.array(image.getpalette("RGB"), np.uint8).reshape(-1, 3)
            indices = np.asarray(image)
            colours = palette[np.unique(indices)]
    except Exception as error:  # a damaged file fails in many ways
        raise UserError(f"{path} is damaged and cannot be decoded ({error}); write or copy it again") from None
    return None if (colours == colours[:, :1]).all() else _upright(indices.astype(np.uint8), data)


def _upright(pixels: np.ndarray, data: bytes) -> np.ndarray:
    """The pixels [H, W] of a PNG as they stood in the file, turned as its EXIF says; OpenCV turns colours and greys so."""
    if b"eXIf" not in data:
        return pixels
    from PIL import Image, ImageOps

    turned = Image.fromarray(pixels)
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            turned.getexif()[_ORIENTATION] = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # a header may be damaged in many ways; OpenCV leaves such a picture as it is
        return pixels
    return np.array(ImageOps.exif_transpose(turned))


def read_bytes(path: Path) -> bytes:
    """The bytes of an image file. Raises UserError naming it."""
    return read_bounded(path, MAX_BYTES)


def _decode(data: bytes, path: Path, flags: int) -> np.ndarray:
    if not data:
        raise UserError(f"{path} is empty; write or copy it again")
    if data.startswith(_JPEG_START):
        begin, end = _image_data(data)
        complete = end >= 0
    elif data.startswith(_PNG_START):
        complete = _PNG_END in data[-_TAIL:]
    else:
        known = (name for name, (at, start) in _STARTS.items() if data[at : at + len(start)] == start)
        if (name := next(known, None)) is not None:
            raise UserError(f"{path} is a {name} picture, and JPEG and PNG are read; convert it to PNG")
        raise UserError(f"{path} is neither a JPEG nor a PNG file, whatever its name says")
    if not complete:
        raise UserError(f"{path} is cut short; write or copy it again")
    width, height = _declared_size(data)
    if width * height > MAX_PIXELS:
        raise UserError(f"{path} claims to have {width}x{height} pixels; images of more than {MAX_PIXELS} are not read")
    if data.startswith(_JPEG_START) and _has_hole(data, begin, end, _most_zeros(data, width, height)):
        raise UserError(f"{path} is damaged: a part of its image data is zero; write or copy it again")
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
    for marker, at in _segments(data):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of a frame
            size = int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
            largest = max(largest, size, key=lambda wh: wh[0] * wh[1])
    return largest


def _image_data(data: bytes) -> tuple[int, int]:
    """Where a JPEG's image data begin and end; -1 where they do not end. Not all of the file need: phones append a short
    video, and some writers pad."""
    begin = next((at for marker, at in _segments(data) if marker == _JPEG_SCAN), 0)  # decoders refuse what has none
    return begin, data.find(_JPEG_END, begin)


def _has_hole(data: bytes, begin: int, end: int, most: int) -> bool:
    """Whether more than `most` zero bytes follow each other, up to the end marker not counted: some cameras pad there."""
    hole = data.find(bytes(most + 1), begin, end)
    return hole >= 0 and bool(data[hole:end].strip(b"\0"))


def _most_zeros(data: bytes, width: int, height: int) -> int:
    """How many zero bytes may follow each other in a JPEG's image data; a hole in a file has more, and decodes to grey.

    Zero bits are each Huffman table's first symbol. Where it is the end of a block for the brightness, a flat block may be
    zeros alone, of a byte at most; so may one in a scan of a part of the picture.
    """
    first: dict[int, int] = {}  # symbol of each table of coefficients
    is_sequential, components = False, 0
    for marker, at in _segments(data):
        if marker == _JPEG_TABLES:
            place, stop = at + 4, min(at + 2 + int.from_bytes(data[at + 2 : at + 4], "big"), len(data))
            while place + 17 < stop:
                if data[place] >> 4:
                    first[data[place] & 15] = data[place + 17]
                place += 17 + sum(data[place + 1 : place + 17])
        elif marker in (0xC0, 0xC1):
            is_sequential, components = True, int.from_bytes(data[at + 9 : at + 10], "big")
        elif marker == _JPEG_SCAN and is_sequential and data[at + 4] == components and first.get(data[at + 6] & 15):
            return _LEAST_ZEROS
    return max(_LEAST_ZEROS, 12 * math.ceil(width / 16) * math.ceil(height / 16))  # blocks of 8 x 8, three channels


def _segments(data: bytes) -> Iterator[tuple[int, int]]:
    """The markers of a JPEG's segments and where they stand, to the first image data, in which none but the end's means
    anything."""
    at = len(_JPEG_START) - 1
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            at += 1  # filling between segments
            continue
        marker = data[at + 1]
        yield marker, at
        if marker == _JPEG_SCAN:
            break
        has_length = 0xC0 <= marker <= 0xFE and not 0xD0 <= marker <= 0xD9
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big") if has_length else 1
