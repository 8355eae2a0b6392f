"""The regions of a frame that are measured by themselves, as 8-bit masks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from avatar.evaluation.protocol import Region
from avatar.head.model import HeadModel
from avatar.types import Camera, Frame

EYEBALLS = ("left_eyeball", "right_eyeball")  # region names of FLAME_masks.pkl
EYE_MARGIN = 0.25  # of the eyeball's projected width and height, on every side: lids and lashes are in the box
OF_EYES: tuple[Region, ...] = ("eyes", "rest")  # they need the head model's eyeballs


def region_masks(frame: Frame, head: HeadModel, wanted: Iterable[Region]) -> dict[Region, UInt8[Tensor, "H W"]]:
    """The masks of the wanted regions (`SHARED_CHOICES["regions"]`); eyes and rest only if the head model has eyeballs."""
    wanted = set(wanted)
    masks: dict[Region, Tensor] = {"head": frame.head_mask, "mouth": frame.mouth_mask}
    if wanted.intersection(OF_EYES) and has_eyeballs(head.assets.regions):
        face = frame.head_mask * (1.0 - frame.mouth_mask)
        eyes = eye_boxes(head.vertices(frame.params), head.assets.regions, frame.camera)
        masks |= {"eyes": face * eyes, "rest": face * ~eyes}
    return {region: (mask * 255.0).round().to(torch.uint8) for region, mask in masks.items() if region in wanted}


def has_eyeballs(regions: Mapping[str, Int[Tensor, " R"]]) -> bool:
    return all(len(regions.get(name, ())) > 0 for name in EYEBALLS)


def eye_boxes(
    vertices: Float[Tensor, "V 3"], regions: Mapping[str, Int[Tensor, " R"]], camera: Camera
) -> Bool[Tensor, "H W"]:
    """True where a pixel's centre lies in the box about a projected eyeball; whether the eye is hidden is not looked at."""
    rows = torch.arange(camera.height)[:, None] + 0.5
    columns = torch.arange(camera.width) + 0.5
    inside = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    for name in EYEBALLS:
        projected = camera.project(vertices[regions[name]])[:, :2]
        low, high = projected.amin(dim=0), projected.amax(dim=0)
        margin = EYE_MARGIN * (high - low)
        (left, top), (right, bottom) = (low - margin).tolist(), (high + margin).tolist()
        inside |= (columns >= left) & (columns <= right) & (rows >= top) & (rows <= bottom)
    return inside
