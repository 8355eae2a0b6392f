"""Evaluation protocols: what exactly is measured, written down, because published figures differ in every one of these.

The choices that all protocols here share are in `SHARED_CHOICES`; `Protocol` holds those in which they differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.data.split import Split
from avatar.errors import UserError
from avatar.lpips_network import MIN_SIZE, Lpips, Net
from avatar.metrics import bounding_box, psnr, ssim

LPIPS_CROP = 64  # pixels; a region is given at least so much context
BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "green": (0.0, 1.0, 0.0)}

SHARED_CHOICES = {
    "truth": "image * (alpha * head mask) + background * (1 - alpha * head mask), rounded to 8 bits",
    "render": "drawn over the same background, clamped to [0, 1] and rounded (not truncated) to 8 bits",
    "masks": "head mask and mouth mask of the data, rounded to 8 bits, used as weights in [0, 1]",
    "psnr": "10 log10(1 / mean square error over pixels and channels) of values / 255, in dB",
    "ssim": "11x11 Gaussian window, sigma 1.5, K 0.01 and 0.03, population covariance, whole windows only, mean of the "
    "channels; as scikit-image's structural_similarity with gaussian_weights=True, use_sample_covariance=False",
    "lpips": "version 0.1, unscaled (not times 0.05), images brought to [-1, 1]",
    "masked": "mean over the head mask alone (weights: the mask) of squared error and of the SSIM map; LPIPS of both "
    f"images times the mask, cropped to its bounding box grown to at least {LPIPS_CROP} pixels",
    "mouth": "the same over the mouth mask",
    "means": "over frames, of the figures of each frame; frames without a mouth pixel have no mouth figure",
}

Figures = dict[str, float]  # "psnr", "ssim", "lpips", each also with "_masked" and "_mouth"
MEASURES = ("psnr", "ssim", "lpips")
REGIONS = ("", "_masked", "_mouth")


@dataclass(frozen=True)
class Protocol:
    """One way to evaluate, every choice that differs from the others named."""

    name: str
    summary: str  # one sentence for people
    source: str
    background: Literal["white", "green"]
    last: int | None  # frames at the end of the video; None: the subject's held-out frames
    multiply: bool  # full-frame figures are of image x head mask (zero outside), else of the composites as they are
    lpips_net: Net

    def choices(self) -> dict[str, str | float | None]:
        """Every choice by name, for results files."""
        return {
            "summary": self.summary,
            "source": self.source,
            "background": f"{self.background} {BACKGROUNDS[self.background]}",
            "frames": "the subject's held-out frames"
            if self.last is None
            else f"of the last {self.last} frames those that were not trained on",
            "full_frame": "image x head mask, mean over the whole frame"
            if self.multiply
            else "composites as they are, mean over the whole frame",
            "lpips_network": self.lpips_net,
        }

    def frames(self, count: int, split: Split) -> tuple[int, ...]:
        """Indices of the frames evaluated out of `count`: never one that was trained on."""
        if self.last is None:
            return split.test
        trained = set(split.train)
        return tuple(index for index in range(max(count - self.last, 0), count) if index not in trained)


PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            name="hypergaussians",
            summary="white background, both images times the head mask, then the mean over the whole frame",
            source="HyperGaussians' metrics; the empty surroundings count as correct, which adds about 6 dB of PSNR "
            "where the mask covers a quarter of the frame",
            background="white",
            last=None,
            multiply=True,
            lpips_net="vgg",
        ),
        Protocol(
            name="flashavatar",
            summary="green background, the frames as rendered, mean over the whole frame",
            source="FlashAvatar's compositing; splats that stick out of the head count against the avatar",
            background="green",
            last=None,
            multiply=False,
            lpips_net="vgg",
        ),
        Protocol(
            name="insta350",
            summary="the last 350 frames that were not trained on, white background, mean over the whole frame",
            source="split of the INSTA data set; papers that use it differ in background (RGBAvatar and "
            "GaussianBlendshapes: black) and LPIPS network",
            background="white",
            last=350,
            multiply=False,
            lpips_net="vgg",
        ),
    )
}


def choose_protocols(names: Sequence[str] | None) -> list[Protocol]:
    """The protocols of these names, all for None; UserError for an unknown name."""
    for name in names or ():
        if name not in PROTOCOLS:
            raise UserError(f"there is no protocol {name!r}; choose from {', '.join(PROTOCOLS)}")
    return [PROTOCOLS[name] for name in dict.fromkeys(names)] if names else list(PROTOCOLS.values())


def to_8_bit(image: Float[Tensor, ...]) -> UInt8[Tensor, ...]:
    """Clamp to [0, 1] and round to the nearest of 256 levels."""
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def measure(
    protocol: Protocol,
    render: UInt8[Tensor, "H W 3"],
    truth: UInt8[Tensor, "H W 3"],
    head_mask: UInt8[Tensor, "H W"],
    mouth_mask: UInt8[Tensor, "H W"],
    lpips: Lpips | None,
) -> Figures:
    """All figures of one frame, from exactly what the PNG files hold. NaN: undefined (empty mask) or not measured."""
    a, b, head, mouth = (tensor.double() / 255.0 for tensor in (render, truth, head_mask, mouth_mask))
    weight = head if protocol.multiply else torch.ones_like(head)
    frame = (a * weight[..., None], b * weight[..., None])
    figures = {"psnr": psnr(*frame).item(), "ssim": ssim(*frame).item(), "lpips": _lpips(lpips, *frame)}
    for region, mask in (("masked", head), ("mouth", mouth)):
        figures[f"psnr_{region}"] = psnr(a, b, mask).item()
        figures[f"ssim_{region}"] = ssim(a, b, mask).item()
        figures[f"lpips_{region}"] = float("nan")
        if crop := lpips_crop(mask):
            inside = mask[crop][..., None]
            figures[f"lpips_{region}"] = _lpips(lpips, a[crop] * inside, b[crop] * inside)
    return figures


def lpips_crop(mask: Float[Tensor, "H W"]) -> tuple[slice, slice] | None:
    """The mask's bounding box, each side grown about its middle to `LPIPS_CROP` pixels where the image has them."""
    box = bounding_box(mask)
    if box is None:
        return None
    sides = []
    for side, size in zip(box, mask.shape, strict=True):
        length = min(max(side.stop - side.start, LPIPS_CROP), size)
        start = min(max((side.start + side.stop - length) // 2, 0), size - length)
        sides.append(slice(start, start + length))
    return sides[0], sides[1]


def _lpips(lpips: Lpips | None, image: Tensor, target: Tensor) -> float:
    if lpips is None or min(image.shape[:2]) < MIN_SIZE:
        return float("nan")
    return lpips(image.float(), target.float()).item()
