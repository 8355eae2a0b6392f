from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from avatar.files.write_image import encode_image, write_image


@pytest.mark.parametrize("channels", [(), (3,), (4,)])
def test_a_png_holds_the_image_with_red_first(channels: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, *channels), dtype=np.uint8)
    decoded = cv2.imdecode(np.frombuffer(encode_image(image), np.uint8), cv2.IMREAD_UNCHANGED)
    if channels:
        decoded = decoded[..., [2, 1, 0, 3][: decoded.shape[2]]]
    np.testing.assert_array_equal(decoded, image)


def test_a_jpeg_keeps_the_colour_of_every_pixel(tmp_path: Path) -> None:
    stripes = np.zeros((16, 16, 3), np.uint8)
    stripes[:, ::2], stripes[:, 1::2] = (200, 60, 60), (60, 60, 200)
    path = tmp_path / "Gesicht \udcff.jpg"  # not UTF-8
    write_image(path, stripes)
    decoded = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(decoded.astype(int), stripes, atol=20)
    assert len(encode_image(stripes, ".jpg", 10)) < len(path.read_bytes())
