"""The pictures of an evaluation as PNG files, so that anyone can compute the figures again."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from avatar.errors import UserError
from avatar.evaluation.measure import Pair
from avatar.evaluation.protocol import REGIONS, Region
from avatar.files.write_image import write_image
from avatar.tensors import to_8_bit

RENDERS, TRACKED_RENDERS = "renders", "tracked_renders"
MASK_FOLDERS: dict[Region, str] = {region: "masks" if region == "head" else f"{region}_masks" for region in REGIONS}
FOLDERS = (RENDERS, TRACKED_RENDERS, "gt", *MASK_FOLDERS.values())


def write_pictures(
    folder: Path, index: int, pair: Pair, masks: Mapping[Region, UInt8[Tensor, "H W"]], renders: str
) -> None:
    """folder/{gt,masks,...}/<index>.png, and the render in `renders`; UserError when the disk refuses.

    A pair of floats is rounded to 8 bits: for looking, not what was measured.
    """
    images = {renders: pair.render, "gt": pair.truth} | {MASK_FOLDERS[region]: mask for region, mask in masks.items()}
    for name, image in images.items():
        path = folder / name / f"{index:05d}.png"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, _pixels(image))
        except OSError as error:
            raise UserError(f"{path} cannot be written ({error.strerror})") from error


def clear_pictures(folder: Path) -> None:
    """Remove the pictures of an earlier evaluation, so that the folders hold one evaluation's frames."""
    for name in FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)


def _pixels(image: Tensor) -> np.ndarray:
    return (image if image.dtype == torch.uint8 else to_8_bit(image)).cpu().numpy()
