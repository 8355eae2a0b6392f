"""How the tracked mesh lies on the masks of a frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from avatar.head.model import HeadModel
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.projection import filled_lips, lip_faces, project_head, silhouette

MEASURED_WIDTH = 256  # pixels; larger frames are measured at this size, distances are given in the frame's own pixels
_ON = 127
_STICKING_SHARE = 0.05  # whose mean is the overhang: one stray triangle must not decide
_NECK = ("neck", "boundary")
_OF_THE_NECK = 0.01  # weight of the root joint, which holds the lower neck in FLAME and nothing above the chin


@dataclass(frozen=True)
class Mesh:
    """Projected head of one frame, in pixels of the size that is measured at."""

    screen: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3], the whole head
    skin_faces: np.ndarray  # [F', 3], without the neck, which may reach under a collar
    lip_faces: np.ndarray  # [F'', 3], empty where the head model has no lips
    head_vertices: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))  # [V'], without the neck


@dataclass(frozen=True)
class Fit:
    """How the tracked mesh lies on the masks. Distances in pixels of the frame; NaN where there is nothing to compare."""

    overlap: float  # IoU of mesh and head mask; hair keeps it below 1; 0 where the mesh is not in the picture
    inside: float  # share of the mesh (without neck) that lies on the head mask; 1 where it fits
    overhang: float  # how far the mesh (without neck) sticks out of the head mask; 0 where it fits
    lips: float  # IoU of projected lips, with what is between them, and mouth mask; 0 where they are not in the picture
    mouth: float  # between the centres of projected lips and mouth mask
    mask_ratio: float  # area of the head mask / area of the mesh without neck
    size: float  # of the projected head without neck, square root of its area
    outside: float = 0.0  # share of the vertices (without neck) that are not in the picture


class MeshProjector:
    """Tracked frames -> Mesh at the measured size. The faces of skin and lips are found once."""

    def __init__(self, head: HeadModel) -> None:
        regions = head.assets.regions
        neck = np.concatenate([regions[name].numpy() for name in _NECK if name in regions] or [np.zeros(0, np.int64)])
        self._head = head
        self._faces = head.faces.numpy()
        self._skin = self._faces[~np.isin(self._faces, neck).any(axis=1)]
        self._lips = lip_faces(head)
        on_neck = head.assets.weights[:, 0].numpy() > _OF_THE_NECK
        on_neck[neck] = True
        self._vertices = np.flatnonzero(~on_neck)

    def __call__(self, track: FrameTrack, width: int, height: int) -> Mesh:
        screen = project_head(self._head, track, track.intrinsics, width, height)
        return Mesh(screen, self._faces, self._skin, self._lips, self._vertices)


def measured_size(width: int, height: int) -> tuple[int, int]:
    scale = min(1.0, MEASURED_WIDTH / width)
    return max(1, round(width * scale)), max(1, round(height * scale))


def fit_of_masks(
    project: MeshProjector, track: FrameTrack, head: np.ndarray | None, mouth: np.ndarray | None
) -> Fit | None:
    """The fit of one frame, whose masks are uint8 [H, W]; None where there is no mask to compare with."""
    known = [mask for mask in (head, mouth) if mask is not None]
    if not known:
        return None
    full_height, full_width = known[0].shape
    size = measured_size(full_width, full_height)
    on, lips = (None if mask is None else _resized(mask, size) > _ON for mask in (head, mouth))
    if on is not None and not on.any():
        return None
    return measure_fit(project(track, *size), on, lips, full_width / size[0], size)


def measure_fit(
    mesh: Mesh, head: np.ndarray | None, mouth: np.ndarray | None, scale: float, size: tuple[int, int]
) -> Fit:
    """`head` and `mouth` are bool [h, w] of `size` (w, h); `scale` is how many pixels of the frame one pixel stands for."""
    width, height = size
    skin = silhouette(mesh.screen, mesh.skin_faces, width, height) > 0
    area = int(skin.sum())
    overlap = inside = overhang = ratio = np.nan
    if head is not None:
        body = silhouette(mesh.screen, mesh.faces, width, height) > 0
        overlap, inside = _iou(body, head), float((skin & head).sum() / max(area, 1))
        if area:
            ratio = float(head.sum() / area)
            outside = cv2.distanceTransform((~head).astype(np.uint8), cv2.DIST_L2, 5)[skin & ~head]
            # Of the whole outline, so that a few pixels of rounding do not count as much as a side that sticks out.
            sticking = np.sort(np.concatenate((outside, np.zeros(round(np.sqrt(area))))))
            overhang = float(sticking[-max(1, round(_STICKING_SHARE * len(sticking))) :].mean()) * scale
    lips = distance = np.nan
    if mouth is not None and mouth.any() and len(mesh.lip_faces):
        projected = filled_lips(mesh.screen, mesh.lip_faces, width, height)
        lips = _iou(projected, mouth)
        if projected.any():
            distance = float(np.hypot(*(_centre(projected) - _centre(mouth)))) * scale
    outside = share_outside(mesh.screen[mesh.head_vertices], width, height)
    size_of_head = float(np.sqrt(area)) * scale if area else np.nan
    return Fit(overlap, inside, overhang, lips, distance, ratio, size_of_head, outside)


def share_outside(screen: np.ndarray, width: int, height: int) -> float:
    """Of points [N, 3] in pixels, those that are not in the picture."""
    x, y = screen[:, 0], screen[:, 1]
    return float(1 - ((x >= 0) & (x < width) & (y >= 0) & (y < height)).mean()) if len(screen) else 0.0


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(int((a | b).sum()), 1))


def _centre(mask: np.ndarray) -> np.ndarray:
    """[2] pixels, column and row, of a mask with something in it."""
    return np.argwhere(mask).mean(axis=0)[::-1]


def _resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return mask if mask.shape[::-1] == size else cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
