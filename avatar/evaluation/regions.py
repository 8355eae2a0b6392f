"""The regions of a frame that are measured by themselves, as 8-bit masks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from avatar.data.frame import Frame
from avatar.evaluation.protocol import RIMS, Region
from avatar.head.model import HeadModel
from avatar.tensors import to_8_bit
from avatar.types import Camera

EYEBALLS = ("left_eyeball", "right_eyeball")  # region names of FLAME_masks.pkl
EYE_MARGIN = 0.25  # of the eyeball's projected width and height, on every side: lids and lashes are in the box
OF_EYES: tuple[Region, ...] = ("eyes", "rest")  # they need the head model's eyeballs
RIM = 8 / 256  # of the longer side: how far a rim reaches to each side of the outline


def region_masks(frame: Frame, head: HeadModel, wanted: Iterable[Region]) -> dict[Region, UInt8[Tensor, "H W"]]:
    """The masks of the wanted regions (`SHARED_CHOICES["regions"]`); eyes and rest only if the head model has eyeballs."""
    wanted = set(wanted)
    masks: dict[Region, Tensor] = {"head": frame.head_mask, "mouth": frame.mouth_mask}
    if not wanted <= masks.keys():
        vertices = head.vertices(frame.params)
        if wanted.intersection(OF_EYES) and has_eyeballs(head.assets.regions):
            face = frame.head_mask * (1.0 - frame.mouth_mask)
            eyes = eye_boxes(vertices, head.assets.regions, frame.camera)
            masks |= {"eyes": face * eyes, "rest": face * ~eyes}
        if wanted.intersection(RIMS):
            is_neck = head.neck()[1] < 0.5  # more on the root than on the neck joint
            rims = outline_rims(frame.alpha * frame.head_mask, frame.camera.project(vertices)[:, :2], is_neck)
            masks |= {region: rim.float() for region, rim in zip(RIMS, rims, strict=True)}
    return {region: to_8_bit(mask) for region, mask in masks.items() if region in wanted}


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


def outline_rims(
    matte: Float[Tensor, "H W"], projected: Float[Tensor, "V 2"], is_neck: Bool[Tensor, " V"]
) -> tuple[Bool[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """The pixels within `RIM` of the outline of matte > 0.5, inside and outside: those of the head, those of the neck.

    projected  the vertices in pixels; a pixel belongs to the neck where the nearest vertex does. The image's border is no
               outline.
    """
    inside = (matte > 0.5).numpy().astype(np.uint8)
    reach = RIM * max(inside.shape)
    # The distance to the nearest pixel of the other kind, of which the pixels at the outline have 1.
    to_other = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    to_other += cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    rim = to_other <= reach
    rows, columns = np.nonzero(rim)
    neck = np.zeros_like(rim)
    if len(rows):
        _, nearest = KDTree(projected.numpy()).query(np.stack((columns + 0.5, rows + 0.5), axis=-1))
        neck[rows, columns] = is_neck.numpy()[nearest]
    return torch.from_numpy(rim & ~neck), torch.from_numpy(neck)
