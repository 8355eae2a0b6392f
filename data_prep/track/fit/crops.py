"""The part of every frame that the fit looks at, small and in memory: grey values around the face."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

Images = Callable[[int], UInt8[np.ndarray, "H W 3"]]
Mattes = Callable[[int], UInt8[np.ndarray, "H W"]]

MARGIN = 0.12  # of the face's box, on every side
MOST_PIXELS = 2**29  # of all crops and mattes together; beyond it they are made smaller


@dataclass(frozen=True)
class Crops:
    """Crops of T frames, all w x h pixels; `scale` crop pixels are one pixel of the frames."""

    grey: UInt8[np.ndarray, "T h w"]
    matte: UInt8[np.ndarray, "T h w"]
    origin: Float[Tensor, "T 2"]  # pixels of the frame at the crop's upper left corner
    scale: float

    def to_crop(self, pixels: Float[Tensor, "T N 2"], frames: slice) -> Float[Tensor, "T N 2"]:
        """Pixels of the given frames -> pixels of their crops (centres at +0.5 in both)."""
        return (pixels - self.origin[frames, None]) * self.scale


def cut_out(
    images: Images,
    mattes: Mattes,
    frames: Iterable[int],
    boxes: Float[np.ndarray, "T 4"],
    scale: float,
) -> Crops:
    """Read the frames one after the other and keep the grey values around `boxes` (left, top, right, bottom in pixels).

    What lies outside of a frame is black and not in the matte.
    """
    middle = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    size = (1 + 2 * MARGIN) * (boxes[:, 2:] - boxes[:, :2]).max(0)  # one size for all
    scale = min(scale, float(np.sqrt(MOST_PIXELS / (2 * len(boxes) * size.prod()))))
    w, h = (int(np.ceil(s * scale)) for s in size)
    origin = middle - 0.5 * np.array([w, h]) / scale
    grey, matte = np.zeros((len(boxes), h, w), np.uint8), np.zeros((len(boxes), h, w), np.uint8)
    for k, frame in enumerate(frames):
        # The centre of crop pixel i lies at origin + (i + 0.5) / scale; cv2 counts centres as whole numbers.
        to_frame = np.column_stack((np.eye(2) / scale, origin[k] + 0.5 / scale - 0.5))
        image = cv2.cvtColor(images(frame), cv2.COLOR_RGB2GRAY)
        grey[k] = _resampled(image, to_frame, w, h, scale)
        matte[k] = _resampled(mattes(frame), to_frame, w, h, scale)
    return Crops(grey, matte, torch.from_numpy(origin), scale)


def _resampled(image: np.ndarray, to_frame: np.ndarray, w: int, h: int, scale: float) -> np.ndarray:
    if scale < 0.8:  # averages what falls together
        image = cv2.GaussianBlur(image, (0, 0), 0.45 / scale)
    return cv2.warpAffine(image, to_frame, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


class BlurredCrops:
    """The grey values in [0, 1], blurred, to be sampled with derivatives."""

    def __init__(self, crops: Crops, sigma: float) -> None:
        T, h, w = crops.grey.shape
        values = np.empty((T, h, w), np.int16)
        for k in range(T):
            blurred = cv2.GaussianBlur(crops.grey[k].astype(np.float32) * (_FULL / 255.0), (0, 0), sigma)
            values[k] = np.rint(blurred)
        self._values = torch.from_numpy(values).flatten()
        self._crops, self._shape = crops, (T, h, w)

    def sample(
        self, pixels: Float[Tensor, "T N 2"], frames: slice
    ) -> tuple[Float[Tensor, "T N"], Float[Tensor, "T N 2"]]:
        """Values and derivatives by the frames' pixels, at pixels of the frames; the border goes on for ever."""
        own = self._crops
        x, y = own.to_crop(pixels, frames).unbind(-1)
        middle = self._at(x, y, frames)
        dx = self._at(x + 0.5, y, frames) - self._at(x - 0.5, y, frames)
        dy = self._at(x, y + 0.5, frames) - self._at(x, y - 0.5, frames)
        return middle, torch.stack((dx, dy), dim=-1) * own.scale

    def values(self, pixels: Float[Tensor, "T N 2"], frames: slice) -> Float[Tensor, "T N"]:
        """The values of `sample` alone, in a fifth of its time."""
        x, y = self._crops.to_crop(pixels, frames).unbind(-1)
        return self._at(x, y, frames)

    def _at(self, x: Tensor, y: Tensor, frames: slice) -> Tensor:
        """Bilinear; the centre of the pixel in column i is at i + 0.5."""
        T, h, w = self._shape
        x, y = (x - 0.5).clamp(0, w - 1.001), (y - 0.5).clamp(0, h - 1.001)
        column, row = x.floor().long(), y.floor().long()
        u, v = (x - column).float(), (y - row).float()
        start = torch.arange(*frames.indices(T))[:, None] * (h * w) + row * w + column
        a, b = self._values[start].float(), self._values[start + 1].float()
        c, d = self._values[start + w].float(), self._values[start + w + 1].float()
        upper, lower = a + u * (b - a), c + u * (d - c)
        return ((upper + v * (lower - upper)) / _FULL).double()


_FULL = 32767.0
