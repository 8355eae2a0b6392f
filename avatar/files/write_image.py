"""Pictures as files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

_TO_OPENCV = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
JPEG_QUALITY = 95  # its size and error beside PNG are in docs/bench/track_results.md


def encode_image(image: np.ndarray, suffix: str = ".png", jpeg_quality: int = JPEG_QUALITY) -> bytes:
    """The file of a uint8 image [H, W], or [H, W, 3] or [H, W, 4] with red first. A JPEG's colours are not subsampled."""
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    pixels = cv2.cvtColor(image, _TO_OPENCV[image.shape[2]]) if image.ndim == 3 else image
    return cv2.imencode(suffix, pixels, options if suffix == ".jpg" else [])[1].tobytes()


def write_image(path: Path, image: np.ndarray, jpeg_quality: int = JPEG_QUALITY) -> None:
    """As JPEG or PNG, by the name's ending."""
    # cv2.imwrite does not notice a full disk, and a name that is not UTF-8 ends the process.
    path.write_bytes(encode_image(image, path.suffix, jpeg_quality))
