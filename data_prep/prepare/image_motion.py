"""How the face moves in the images against how the tracked mesh moves: optical flow where lips, eyelids and face are.

The second witness for the image/tracking offset, for when the masks do not decide: speech and blinks are sharp in time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from avatar.compute.processors import processor_count
from avatar.data.read_image import read_image
from avatar.head.model import HeadModel
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.projection import project_head

_EYELID_MOVES = 0.5  # of the largest displacement of the eyelid's blendshape


def motion_residuals(
    head: HeadModel,
    tracks: Mapping[int, FrameTrack],
    intrinsics: np.ndarray,
    images: Mapping[int, Path],
    candidates: Sequence[int],
    sampled: Sequence[int],
    size: tuple[int, int],
) -> dict[int, dict[int, np.ndarray]]:
    """Offset -> tracking frame -> image motion minus mesh motion to the next frame [2 values per group of vertices].

    In pixels of an image of `size` (width, height). Offsets and frames without a pair of images are left out.
    """
    groups = _vertex_groups(head)
    if not groups:
        return {}
    before, motion = {}, {}
    for number in sampled:
        if number + 1 in tracks:
            before[number] = project_head(head, tracks[number], intrinsics, *size)[:, :2]
            motion[number] = project_head(head, tracks[number + 1], intrinsics, *size)[:, :2] - before[number]
    needed = sorted({n + offset for n in before for offset in candidates})
    flows = _flows([n for n in needed if n in images and n + 1 in images], images, size)
    residuals: dict[int, dict[int, np.ndarray]] = {}
    for offset in candidates:
        rows = {}
        for number, positions in before.items():
            if number + offset in flows:
                seen = _sample(flows[number + offset], positions)
                rows[number] = np.concatenate([(seen - motion[number])[group].mean(axis=0) for group in groups])
        if rows:
            residuals[offset] = rows
    return residuals


def _vertex_groups(head: HeadModel) -> list[np.ndarray]:
    """Vertex indices of the face, upper and lower lip, and each eyelid; those that the head model has."""
    height = head.assets.template[:, 1].numpy()
    regions = {name: index.numpy() for name, index in head.assets.regions.items()}
    groups = [regions["face"]] if "face" in regions else []
    if "lips" in regions:
        is_upper = height[regions["lips"]] >= height[regions["lips"]].mean()
        groups += [regions["lips"][is_upper], regions["lips"][~is_upper]]
    for eyelid in head.assets.eyelid_dirs.numpy():
        displacement = np.linalg.norm(eyelid, axis=1)
        if displacement.max() > 0:
            groups.append(np.flatnonzero(displacement > _EYELID_MOVES * displacement.max()))
    return [group for group in groups if len(group)]


def _flows(numbers: Sequence[int], images: Mapping[int, Path], size: tuple[int, int]) -> dict[int, np.ndarray]:
    """Optical flow [H, W, 2] from image n to image n + 1."""

    def grey(number: int) -> np.ndarray:
        return cv2.resize(
            cv2.cvtColor(read_image(images[number]), cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA
        )

    with ThreadPoolExecutor(processor_count()) as pool:
        both = sorted({*numbers, *(n + 1 for n in numbers)})
        pictures = dict(zip(both, pool.map(grey, both), strict=True))
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return {n: flow.calc(pictures[n], pictures[n + 1], None) for n in numbers}  # type: ignore[call-overload]


def _sample(flow: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Flow [V, 2] at pixel positions [V, 2]; the centre of the first pixel is at 0.5."""
    at = (positions - 0.5).astype(np.float32)[:, None]
    empty = np.zeros((0,), np.float32)
    return cv2.remap(flow, at, empty, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
