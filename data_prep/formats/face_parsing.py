"""Class maps of the face parsing network BiSeNet (trained on CelebAMask-HQ), from which head and mouth masks are made.

0 background, 1 skin, 2-3 brows, 4-5 eyes, 6 glasses, 7-9 ears and earring, 10 nose, 11 mouth, 12-13 lips, 14 neck,
15 necklace, 16 cloth, 17 hair, 18 hat.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avatar.data.read_image import decode_image

HEAD = (*range(1, 15), 17, 18)
MOUTH = (11, 12, 13)
_INSTA_RED = (0, 250, 240, 230, 210, 200, 190, 180, 170, 160, 150, 140, 130, 120, 110, 100, 90, 80, 70)
_CLASS_OF_RED = np.zeros(256, np.uint8)
_CLASS_OF_RED[list(_INSTA_RED)] = np.arange(len(_INSTA_RED))


def decode_reds(data: bytes, path: Path) -> np.ndarray:
    """uint8 [H, W] classes of INSTA's `seg_mask/`, where each class has its own red; other values are background."""
    return _CLASS_OF_RED[decode_image(data, path)[..., 0]]


def mask_of(classes: np.ndarray, wanted: tuple[int, ...]) -> np.ndarray:
    """uint8 [H, W], 255 where the class is one of the wanted ones, else 0."""
    return np.where(np.isin(classes, wanted), np.uint8(255), np.uint8(0))
