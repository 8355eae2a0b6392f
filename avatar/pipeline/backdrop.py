"""What lies behind an avatar in a reenactment: a colour, a picture, or nothing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.data.colours import COLOURS, parse_colour
from avatar.data.read_image import read_image
from avatar.errors import UserError
from avatar.tensors import to_8_bit
from avatar.types import Rendering

TRANSPARENT = "transparent"


@dataclass(frozen=True)
class Backdrop:
    name: str  # as it was asked for
    behind: Float[Tensor, "*size 3"] | None  # a colour [3] or a picture [H, W, 3] in [0, 1]; None: transparent

    def pixels(self, rendering: Rendering, trained: Float[Tensor, " 3"]) -> UInt8[np.ndarray, "H W C"]:
        """The rendering in place of over the colour `trained`: image + (1 - alpha) (behind - trained). RGB, or RGBA with
        straight alpha where nothing lies behind."""
        image, alpha = rendering.image.detach().cpu(), rendering.alpha.detach().cpu()[..., None]
        if self.behind is None:
            head = (image - (1 - alpha) * trained) / alpha.clamp(min=1e-3)
            return to_8_bit(torch.cat((head, alpha), dim=-1)).numpy()
        behind = self.behind if self.behind.ndim == 1 else _covering(self.behind, image.shape[0], image.shape[1])
        return to_8_bit(image + (1 - alpha) * (behind - trained)).numpy()


def parse_backdrop(word: str) -> Backdrop:
    """What --background names. Raises UserError for what is neither a colour nor a picture."""
    if word == TRANSPARENT:
        return Backdrop(word, None)
    try:
        return Backdrop(word, torch.tensor(parse_colour(word)))
    except ValueError:
        path = Path(word)
    if not path.is_file():
        raise UserError(f"--background is {TRANSPARENT}, {', '.join(COLOURS)}, #rrggbb or a picture, not {word}")
    return Backdrop(word, torch.from_numpy(read_image(path)) / 255.0)


@lru_cache(maxsize=1)  # every frame asks for the same
def _covering(picture: Float[Tensor, "H W 3"], height: int, width: int) -> Float[Tensor, "height width 3"]:
    """The middle of a picture that has the frame's shape, at the frame's size."""
    H, W = picture.shape[:2]
    rows, columns = min(H, max(1, round(W * height / width))), min(W, max(1, round(H * width / height)))
    top, left = (H - rows) // 2, (W - columns) // 2
    middle = picture[top : top + rows, left : left + columns].numpy()
    shrinks = rows > height
    return torch.from_numpy(
        cv2.resize(middle, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    )
