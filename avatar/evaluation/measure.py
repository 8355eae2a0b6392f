"""The figures of one frame by one or several protocols; what protocols have in common is computed once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from avatar.compute.device import CPU, to_device
from avatar.evaluation.protocol import ImageFormat, Protocol, Region, column, columns_of
from avatar.losses.lpips_network import MIN_SIZE, Lpips, Net
from avatar.losses.metrics import SSIM_RADIUS, bounding_box, grown_box, squared_error, ssim_map, weighted_mean
from avatar.tensors import to_8_bit

LPIPS_CROP = 64  # pixels; a region is given at least so much context
INSIDE = slice(SSIM_RADIUS, -SSIM_RADIUS)  # where SSIM's windows have their centres

Figures = dict[str, float]  # by `Protocol.columns`


class Pair(NamedTuple):
    """What is compared: uint8 for 8-bit levels, else float32."""

    render: Tensor  # [H, W, 3]
    truth: Tensor  # [H, W, 3]


def as_seen(image: Float[Tensor, "..."], image_format: ImageFormat) -> Tensor:
    """An image as a protocol compares it: uint8 after rounding or truncation, or float32."""
    if image_format.clamp:
        image = image.clamp(0.0, 1.0)
    return image if image_format.levels == "float" else to_8_bit(image, image_format.levels == "truncate")


class FrameMeasurer:
    """Figures of one frame. Maps of squared error and SSIM, which take the time, are shared between protocols."""

    def __init__(
        self,
        pairs: Mapping[ImageFormat, Pair],
        masks: Mapping[Region, UInt8[Tensor, "H W"]],
        networks: Mapping[Net, Lpips | None],
    ) -> None:
        """`masks` lacks a region that the head model cannot show; "head" is there always."""
        self._pairs = {image_format: tuple(_as_values(image) for image in pair) for image_format, pair in pairs.items()}
        device = next((pair[0].device for pair in self._pairs.values()), CPU)
        self._masks = {region: to_device(mask, device).double() / 255.0 for region, mask in masks.items()}
        self._networks = networks
        self._maps: dict[tuple[ImageFormat, bool], tuple[Tensor, Tensor]] = {}
        self._lpips: dict[tuple[ImageFormat, str, Net], float] = {}

    def measure(self, protocol: Protocol) -> Figures:
        """All figures of the protocol but its jitter. NaN: undefined (a region without a pixel) or not measured."""
        figures: Figures = {}
        for region in (None, *protocol.regions):
            mask = None
            if region is not None or protocol.mask == "only":
                mask = self._masks.get(region or "head")
                if mask is None:
                    figures |= dict.fromkeys(columns_of(region), float("nan"))
                    continue
            multiply = region is None and protocol.mask == "multiply"
            error, similarity = self._maps_of(protocol.image_format, multiply)
            inside = None if mask is None else mask[INSIDE, INSIDE]
            figures[column("psnr", region)] = -10.0 * torch.log10(weighted_mean(error, mask)).item()
            figures[column("ssim", region)] = weighted_mean(similarity, inside).item()
            if (lpips := column("lpips", region)) in columns_of(region):
                what = region or ("head" if protocol.mask == "only" else protocol.mask)
                figures[lpips] = protocol.lpips_scale * self._lpips_of(protocol, what)
        return figures

    def _images(self, image_format: ImageFormat, multiply: bool) -> tuple[Tensor, Tensor]:
        render, truth = self._pairs[image_format]
        if not multiply:
            return render, truth
        weight = self._masks["head"][..., None]
        return render * weight, truth * weight

    def _maps_of(
        self, image_format: ImageFormat, multiply: bool
    ) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H-10 W-10"]]:
        key = (image_format, multiply)
        if key not in self._maps:
            images = self._images(image_format, multiply)
            self._maps[key] = squared_error(*images), ssim_map(*images).mean(dim=-1)
        return self._maps[key]

    def _lpips_of(self, protocol: Protocol, what: str) -> float:
        """LPIPS before scaling; `what` is a region, or "multiply" or "none" for the whole frame."""
        key = (protocol.image_format, what, protocol.lpips_net)
        if key not in self._lpips:
            network = self._networks[protocol.lpips_net]
            images = self._images(protocol.image_format, what == "multiply")
            if what in self._masks:
                self._lpips[key] = lpips_in_mask(network, images, self._masks[what])
            else:
                self._lpips[key] = _lpips(network, *images)
        return self._lpips[key]


def lpips_crop(mask: Shaped[Tensor, "H W"]) -> tuple[slice, slice] | None:
    """The mask's bounding box, each side grown about its middle to `LPIPS_CROP` pixels where the image has them."""
    box = bounding_box(mask)
    return None if box is None else grown_box(box, (mask.shape[0], mask.shape[1]), least=LPIPS_CROP)


def lpips_in_mask(network: Lpips | None, images: tuple[Tensor, Tensor], mask: Float[Tensor, "H W"]) -> float:
    """LPIPS of two images [H, W, 3] times the mask, on its crop; NaN without a network or for an empty mask."""
    crop = lpips_crop(mask)
    if crop is None:
        return float("nan")
    inside = mask[crop][..., None]
    return _lpips(network, images[0][crop] * inside, images[1][crop] * inside)


def _lpips(network: Lpips | None, image: Tensor, target: Tensor) -> float:
    if network is None or min(image.shape[:2]) < MIN_SIZE:
        return float("nan")
    return network(image.float(), target.float()).item()


def _as_values(image: Tensor) -> Float[Tensor, "H W 3"]:
    """float64: the variance in SSIM is a difference of two nearly equal numbers."""
    return image.double() / 255.0 if image.dtype == torch.uint8 else image.double()
