"""How the tracked mesh lies on the masks of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatar.head.model import HeadModel
from data_prep.check.view import measured_size
from data_prep.projection import filled_lips, project_head, region_faces, silhouette
from data_prep.tracking import FrameTrack

_ON = 127
_STICKING_SHARE = 0.05  # whose mean is the overhang: one stray triangle must not decide
_NECK = ("neck", "boundary")


@dataclass(frozen=True)
class Mesh:
    """Projected head of one frame, in pixels of the size that is measured at."""

    screen: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3], the whole head
    skin_faces: np.ndarray  # [F', 3], without the neck, which may reach under a collar
    lip_faces: np.ndarray  # [F'', 3], empty where the head model has no lips


@dataclass(frozen=True)
class Fit:
    """How the tracked mesh lies on the masks. Distances in pixels of the frame."""

    overlap: float  # IoU of mesh and head mask; hair keeps it below 1
    inside: float  # share of the mesh (without neck) that lies on the head mask; 1 where it fits
    overhang: float  # how far the mesh (without neck) sticks out of the head mask; 0 where it fits
    mouth: float  # between the centres of projected lips and mouth mask; NaN where either is empty
    mask_ratio: float  # area of the head mask / area of the mesh without neck
    size: float  # of the projected head without neck, square root of its area


class MeshProjector:
    """Tracked frames -> Mesh at the measured size. The faces of skin and lips are found once."""

    def __init__(self, head: HeadModel, intrinsics: np.ndarray) -> None:
        regions = head.assets.regions
        neck = np.concatenate([regions[name].numpy() for name in _NECK if name in regions] or [np.zeros(0, np.int64)])
        self._head, self._intrinsics = head, intrinsics
        self._faces = head.faces.numpy()
        self._skin = self._faces[~np.isin(self._faces, neck).any(axis=1)]
        self._lips = region_faces(head, "lips")

    def __call__(self, track: FrameTrack, width: int, height: int) -> Mesh:
        screen = project_head(self._head, track, self._intrinsics, width, height)
        return Mesh(screen, self._faces, self._skin, self._lips)


def fit_of_masks(project: MeshProjector, track: FrameTrack, head: np.ndarray, mouth: np.ndarray | None) -> Fit | None:
    """The fit of one frame, whose masks are uint8 [H, W]; None where mask or mesh is empty."""
    full_width = head.shape[1]
    width, height = measured_size(full_width, head.shape[0])
    on = _resized(head, (width, height)) > _ON
    if not on.any():
        return None
    lips = None if mouth is None else _resized(mouth, (width, height)) > _ON
    return measure_fit(project(track, width, height), on, lips, full_width / width)


def measure_fit(mesh: Mesh, head: np.ndarray, mouth: np.ndarray | None, scale: float) -> Fit | None:
    """`head` and `mouth` are bool [h, w]; `scale` is how many pixels of the frame one measured pixel stands for.

    None where the mesh is not in the picture.
    """
    height, width = head.shape
    body = silhouette(mesh.screen, mesh.faces, width, height) > 0
    skin = silhouette(mesh.screen, mesh.skin_faces, width, height) > 0
    if not skin.any():
        return None
    outside = cv2.distanceTransform((~head).astype(np.uint8), cv2.DIST_L2, 5)[skin & ~head]
    area = int(skin.sum())
    # Of the whole outline, so that a few pixels of rounding do not count as much as a side that sticks out.
    sticking = np.concatenate((outside, np.zeros(round(np.sqrt(area)))))
    distance = np.nan
    if mouth is not None and len(mesh.lip_faces):
        lips = _centre(filled_lips(mesh.screen, mesh.lip_faces, width, height))
        seen = _centre(mouth.astype(np.uint8))
        distance = float(np.hypot(*(lips - seen)))
    return Fit(
        overlap=float((body & head).sum() / max(int((body | head).sum()), 1)),
        inside=float((skin & head).sum() / area),
        overhang=float(np.sort(sticking)[-max(1, round(_STICKING_SHARE * len(sticking))) :].mean()) * scale,
        mouth=distance * scale,
        mask_ratio=float(head.sum() / area),
        size=float(np.sqrt(area)) * scale,
    )


def _centre(mask: np.ndarray) -> np.ndarray:
    """[2] pixels; NaN where the mask is empty."""
    m = cv2.moments(mask, True)
    return np.array([m["m10"], m["m01"]]) / m["m00"] if m["m00"] else np.full(2, np.nan)


def _resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return mask if mask.shape[::-1] == size else cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
