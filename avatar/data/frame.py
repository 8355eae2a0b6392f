"""One frame of a subject, and how it is composited over a background."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from avatar.types import Camera, HeadParams


@dataclass(frozen=True)
class Frame:
    """One frame of a prepared subject, decoded."""

    index: int  # position in the prepared subject, 0-based
    name: str  # stem of the image file, for example "00001"
    camera: Camera
    params: HeadParams
    image: Float[Tensor, "H W 3"]  # as in the video file, not composited; of a smaller size see `FramePixels.resized`
    alpha: Float[Tensor, "H W"]  # foreground matte; ones where the subject has none
    head_mask: Float[Tensor, "H W"]  # head and neck; ones where the subject has none
    mouth_mask: Float[Tensor, "H W"]  # lips and inner mouth
    head_box: tuple[slice, slice] | None = None  # rows and columns that hold the head mask, if they are known already
    shared_time: int | None = None  # the row of the tracks, where pictures of several cameras share it; None: `index`
    seen: Bool[Tensor, "H W"] | None = None  # pixels that the camera's picture holds; None: all

    @property
    def time(self) -> int:
        """The row of the tracks that `params` are of."""
        return self.index if self.shared_time is None else self.shared_time

    def composite(self, background: Float[Tensor, " 3"]) -> Float[Tensor, "H W 3"]:
        """The training target: matte over the background, then the head mask over the background again.

        Source: FlashAvatar and HyperGaussians, data loading (`img*alpha + bg*(1-alpha)`, then `*mask + bg*(1-mask)`).
        """
        # The weight times (image - background), in one pass; exact where the weight is 0 or 1.
        return torch.lerp(background, self.image, (self.alpha * self.head_mask)[..., None])
