"""Image and mask files as pixels: every way in which a PNG can be transparent means the same matte."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from avatar.data.read_image import read_image, read_mask, read_matte
from avatar.errors import UserError

MATTE = np.array([[0, 1, 9, 10], [40, 128, 254, 255]], np.uint8)
COLOUR = np.full((2, 4, 3), (10, 120, 200), np.uint8)  # blue first, as OpenCV writes


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def palette_png(matte: np.ndarray) -> bytes:
    """One palette entry per level of the matte, all of the same colour."""
    levels = np.unique(matte)
    rows = b"".join(b"\0" + np.searchsorted(levels, row).astype(np.uint8).tobytes() for row in matte)
    header = struct.pack(">IIBBBBB", matte.shape[1], matte.shape[0], 8, 3, 0, 0, 0)
    parts = (
        (b"IHDR", header),
        (b"PLTE", bytes((200, 120, 10)) * len(levels)),
        (b"tRNS", levels.tobytes()),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def grey_alpha_png(matte: np.ndarray) -> bytes:
    rows = b"".join(b"\0" + np.stack((np.full_like(row, 120), row), axis=1).tobytes() for row in matte)
    header = struct.pack(">IIBBBBB", matte.shape[1], matte.shape[0], 8, 4, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def rgba_png(matte: np.ndarray, kind: type = np.uint8) -> bytes:
    scale = kind(np.iinfo(kind).max // 255)
    return cv2.imencode(".png", np.dstack((COLOUR, matte)).astype(kind) * scale)[1].tobytes()


TRANSPARENT = {
    "8 bits a channel": rgba_png(MATTE),
    "16 bits a channel": rgba_png(MATTE, np.uint16),
    "grey with alpha": grey_alpha_png(MATTE),
    "a palette with transparent colours": palette_png(MATTE),
}


@pytest.mark.parametrize("kind", TRANSPARENT)
def test_the_transparency_of_a_png_is_the_matte(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "00001.png"
    path.write_bytes(TRANSPARENT[kind])
    np.testing.assert_array_equal(read_mask(path), MATTE)
    np.testing.assert_array_equal(read_matte(path, path), MATTE)
    expected = (120, 120, 120) if kind == "grey with alpha" else (200, 120, 10)
    assert (read_image(path) == expected).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_matte_is_turned_as_its_picture_is(orientation: int, tmp_path: Path) -> None:
    """By the EXIF of a PNG, as telephones and programs that cut people out leave it."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "00001.png"
    Image.fromarray(np.dstack([MATTE] * 4)).save(path, exif=exif)
    np.testing.assert_array_equal(read_matte(path, path), read_image(path)[..., 0])
    np.testing.assert_array_equal(read_mask(path), read_image(path)[..., 0])
    labels = Image.frombytes("P", (4, 2), bytes(range(8)))
    labels.putpalette([value for n in range(8) for value in (n, 0, 255)])
    labels.save(path, exif=exif)
    np.testing.assert_array_equal(read_mask(path), read_image(path)[..., 0])


def test_16_bits_are_rounded_to_the_nearest_of_8(tmp_path: Path) -> None:
    levels = np.array([[0, 128, 129, 32767, 32768, 65406, 65407, 65535]], np.uint16)
    pixels = np.dstack([np.zeros_like(levels)] * 3 + [levels])
    assert cv2.imwrite(str(tmp_path / "x.png"), pixels)
    assert read_mask(tmp_path / "x.png").tolist() == [[0, 0, 1, 127, 128, 254, 255, 255]]


def test_an_opaque_mask_file_is_its_luminance_and_an_opaque_image_is_all_foreground(tmp_path: Path) -> None:
    path = tmp_path / "x.png"
    path.write_bytes(rgba_png(np.full_like(MATTE, 255)))
    grey = cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(read_mask(path), grey)
    np.testing.assert_array_equal(read_matte(path, tmp_path / "image.png"), grey)
    assert (read_matte(path, path) == 255).all()
    assert cv2.imwrite(str(tmp_path / "x.jpg"), COLOUR)
    assert (read_matte(tmp_path / "x.jpg", tmp_path / "x.jpg") == 255).all()


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpegs_image_data_must_end_and_the_file_may_go_on(progressive: int, tmp_path: Path) -> None:
    """Phones put a thumbnail with an end of its own before the picture, and a video behind it."""
    picture, path = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8), tmp_path / "x.jpg"
    data = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_PROGRESSIVE, progressive))[1].tobytes()
    data = data[:2] + b"\xff\xe1\0\x06ab\xff\xd9" + data[2:]
    path.write_bytes(data)
    expected = read_image(path)
    path.write_bytes(data + b"\0\0\0\x18ftypmp42" + bytes(10_000))
    np.testing.assert_array_equal(read_image(path), expected)
    for kept in (len(data) - 2, len(data) // 2):
        path.write_bytes(data[:kept])
        with pytest.raises(UserError, match="is cut short; write or copy it again"):
            read_image(path)


HUFFMAN = ((), (cv2.IMWRITE_JPEG_OPTIMIZE, 1), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1))


@pytest.mark.parametrize("options", HUFFMAN)
def test_a_jpeg_with_a_hole_is_refused(options: tuple[int, ...], tmp_path: Path) -> None:
    """Decoders take the zeros of a damaged download for grey, and raise nothing."""
    picture, path = np.random.default_rng(0).integers(0, 256, (160, 240, 3), np.uint8), tmp_path / "x.jpg"
    data = cv2.imencode(".jpg", picture, options)[1].tobytes()
    path.write_bytes(data)
    read_image(path)
    at, hole = len(data) // 2, 2000
    path.write_bytes(data[:at] + bytes(hole) + data[at + hole :])
    with pytest.raises(UserError, match=r"x\.jpg is damaged: a part of its image data is zero; write or copy it again"):
        read_image(path)


def test_zeros_before_the_end_marker_are_no_hole(tmp_path: Path) -> None:
    """As some cameras pad their pictures."""
    picture, path = np.random.default_rng(0).integers(0, 256, (160, 240, 3), np.uint8), tmp_path / "x.jpg"
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    path.write_bytes(data)
    whole = read_image(path)
    path.write_bytes(data[:-2] + bytes(3000) + data[-2:])
    np.testing.assert_array_equal(read_image(path), whole)


@pytest.mark.parametrize("options", HUFFMAN)
@pytest.mark.parametrize("shape", [(1, 1, 3), (500, 900), (500, 900, 3)])
def test_a_flat_jpeg_has_no_hole(shape: tuple[int, ...], options: tuple[int, ...], tmp_path: Path) -> None:
    """The codes of a flat picture are zeros, for a kilobyte and more."""
    picture = np.zeros(shape, np.uint8)
    for value in (0, 255):
        (tmp_path / "x.jpg").write_bytes(cv2.imencode(".jpg", picture + np.uint8(value), options)[1].tobytes())
        assert (read_image(tmp_path / "x.jpg") == value).all()
    if shape == (500, 900, 3) and cv2.IMWRITE_JPEG_OPTIMIZE in options:
        assert bytes(1000) in (tmp_path / "x.jpg").read_bytes()
