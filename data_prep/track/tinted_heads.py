"""Pictures of random heads of a head model, in plain colours, good enough for a face landmarker to find its points."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from avatar.head.assets import HeadAssets
from avatar.head.model import LEFT_EYE, RIGHT_EYE, HeadModel
from avatar.head.rasterize import rasterize_mesh
from avatar.types import HeadParams
from data_prep.track.expression_kind import is_statistical, used_expressions
from data_prep.track.motion import gaze_rotations, rotations

SIZE = 384  # pixels, the whole picture
EYE_DISTANCE = 78.0  # pixels between the eyes' centres of a head seen from in front
CAMERA_DISTANCE = 14.0  # in distances between the eyes: 0.9 m
POSE_SPREAD = np.radians([9.0, 16.0, 5.0])  # pitch, yaw, roll
POSE_LIMIT = np.radians([20.0, 34.0, 12.0])
_SKIN = np.array([[0.87, 0.68, 0.58], [0.80, 0.58, 0.47], [0.66, 0.46, 0.36], [0.48, 0.32, 0.24]])  # sRGB
_IRIS_ANGLE, _PUPIL_ANGLE = np.radians(28.0), np.radians(12.0)  # from the eye's axis
_BROW_UP, _BROW_HALF_HEIGHT, _BROW_REACH = 0.31, 0.035, 0.34  # in distances between the eyes, from the eye's centre
_FLIP = np.diag([1.0, -1.0, -1.0])  # head axes (y up, z forward) in front of an OpenCV camera


class TintedHead(NamedTuple):
    image: np.ndarray  # uint8 [SIZE, SIZE, 3]
    screen: np.ndarray  # float64 [V, 3] pixels and depth of the vertices
    is_visible: np.ndarray  # bool [V]


def render_tinted_heads(assets: HeadAssets, count: int, seed: int = 0) -> Iterator[TintedHead]:
    """`count` random identities with random expressions, poses, skin and light; the same ones for the same seed."""
    rng = np.random.default_rng(seed)
    faces = assets.faces.numpy()
    paint = _Paint(assets)
    used = used_expressions(assets).numpy()
    statistical = is_statistical(assets)
    directions = int((assets.shape_dirs != 0).any(0).any(0).nonzero().max()) + 1 if assets.shape_dirs.any() else 0
    for _ in range(count):
        identity = torch.from_numpy(np.clip(rng.normal(0.0, 0.7, directions), -1.5, 1.5))
        expression = np.zeros(assets.num_expressions)
        if statistical:
            expression[used] = rng.normal(0.0, 0.7, len(used))
        else:
            some = rng.choice(used, min(5, len(used)), replace=False)
            expression[some] = rng.uniform(0.0, 0.6, len(some))
        head = HeadModel(assets, identity.float())
        jaw = torch.tensor([max(0.0, rng.normal(0.08, 0.10)), 0.0, 0.0], dtype=torch.float64)
        gaze = torch.from_numpy(np.tile(rng.normal(0.0, 0.10, 2), (2, 1)))
        params = HeadParams(
            expression=torch.from_numpy(expression).float(),
            jaw=rotations(jaw)[:2].reshape(6).float(),
            eyes=gaze_rotations(gaze)[:, :2].reshape(12).float(),
            eyelids=torch.full((2,), float(np.clip(rng.normal(0.15, 0.25), 0.0, 0.9))),
            neck=torch.eye(3)[:2].reshape(6),
        )
        pitch, yaw, roll = np.clip(rng.normal(0.0, 1.0, 3) * POSE_SPREAD, -POSE_LIMIT, POSE_LIMIT)
        turn = rotations(torch.tensor([[0.0, yaw, 0.0], [pitch, 0.0, 0.0], [0.0, 0.0, roll]], dtype=torch.float64))
        vertices = head.vertices(params).numpy().astype(np.float64)
        screen = _project(assets, vertices, (turn[0] @ turn[1] @ turn[2]).numpy())
        raster = rasterize_mesh(screen, faces, SIZE, SIZE)
        colours = paint(rng)
        yield TintedHead(_shade(raster, screen, faces, colours, rng), screen, visible_vertices(raster.depth, screen))


def visible_vertices(depth: np.ndarray, screen: np.ndarray, tolerance: float = 3e-3) -> np.ndarray:
    """[V] whether a vertex lies in the picture and not behind what the z-buffer [H, W] holds, but for `tolerance` metres."""
    H, W = depth.shape
    column, row = np.floor(screen[:, 0]).astype(int), np.floor(screen[:, 1]).astype(int)
    inside = (column >= 0) & (column < W) & (row >= 0) & (row < H) & (screen[:, 2] > 0)
    nearest = depth[np.clip(row, 0, H - 1), np.clip(column, 0, W - 1)]
    return inside & ((nearest == 0) | (screen[:, 2] <= nearest + tolerance))


def _project(assets: HeadAssets, vertices: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Screen coordinates of a head whose face is in the middle of the picture."""
    eyes = (assets.joint_regressor @ assets.template).numpy()[[LEFT_EYE, RIGHT_EYE]]
    distance = float(np.linalg.norm(eyes[0] - eyes[1]))
    middle = eyes.mean(0) - np.array([0.0, 0.35 * distance, 0.0])
    p = (vertices - middle) @ (_FLIP @ turn).T + np.array([0.0, 0.0, CAMERA_DISTANCE * distance])
    focal = EYE_DISTANCE * CAMERA_DISTANCE
    return np.stack((focal * p[:, 0] / p[:, 2] + SIZE / 2, focal * p[:, 1] / p[:, 2] + SIZE / 2, p[:, 2]), -1)


class _Paint:
    """Colours of the vertices: skin, brows, lips, eyes."""

    def __init__(self, assets: HeadAssets) -> None:
        template, weights = assets.template.numpy(), assets.weights.numpy()
        centres = (assets.joint_regressor @ assets.template).numpy()[[LEFT_EYE, RIGHT_EYE]]
        unit = np.linalg.norm(centres[0] - centres[1])
        V = len(template)
        self.lips = np.zeros(V, bool)
        if "lips" in assets.regions:
            self.lips[assets.regions["lips"].numpy()] = True
        self.brows, self.eyes, self.iris, self.pupil = np.zeros(V), np.zeros(V, bool), np.zeros(V, bool), np.zeros(V, bool)
        for joint, centre in zip((LEFT_EYE, RIGHT_EYE), centres, strict=True):
            offset = template - centre
            ball = weights[:, joint] > 0.5
            angle = np.arctan2(np.hypot(offset[:, 0], offset[:, 1]), offset[:, 2])
            self.eyes |= ball
            self.iris |= ball & (angle < _IRIS_ANGLE)
            self.pupil |= ball & (angle < _PUPIL_ANGLE)
            across, up = np.abs(offset[:, 0]) / unit, offset[:, 1] / unit
            arch = _BROW_UP - 0.25 * across**2
            brow = np.exp(-(((up - arch) / _BROW_HALF_HEIGHT) ** 2)) * (across < _BROW_REACH)
            self.brows = np.maximum(self.brows, np.where(offset[:, 2] > -0.2 * unit, brow, 0.0))

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        """float64 [V, 3]; another skin, other lips, brows and eyes each time."""
        tone = rng.uniform(0, len(_SKIN) - 1)
        below = min(int(tone), len(_SKIN) - 2)
        skin = (_SKIN[below] + (tone - below) * (_SKIN[below + 1] - _SKIN[below])) * rng.uniform(0.9, 1.1, 3)
        colours = np.tile(skin, (len(self.lips), 1))
        colours[self.lips] = skin * np.array([0.92, 0.62, 0.62]) * rng.uniform(0.85, 1.0)
        colours += (self.brows * rng.uniform(0.4, 0.8))[:, None] * (np.array([0.16, 0.11, 0.08]) - colours)
        colours[self.eyes] = 0.93
        colours[self.iris] = np.array([[0.30, 0.19, 0.10], [0.25, 0.36, 0.48], [0.24, 0.32, 0.20]])[rng.integers(3)]
        colours[self.pupil] = 0.04
        return colours


def _shade(raster, screen: np.ndarray, faces: np.ndarray, colours: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Diffuse light from above and one side, over a plain background."""
    corners = screen[faces]
    # In the picture's own space x : y : z have nearly one scale; good enough for the light.
    scale = np.array([1.0, 1.0, EYE_DISTANCE * CAMERA_DISTANCE / np.median(screen[:, 2])])
    a, b = (corners[:, 1] - corners[:, 0]) * scale, (corners[:, 2] - corners[:, 0]) * scale
    normals = np.cross(a, b)
    of_vertices = np.zeros_like(screen)
    for k in range(3):
        np.add.at(of_vertices, faces[:, k], normals)
    of_vertices /= np.maximum(np.linalg.norm(of_vertices, axis=1, keepdims=True), 1e-12)
    light = np.array([rng.uniform(-0.7, 0.7), -0.5, -1.0])  # towards the light; y points down, z away
    lit = np.clip(of_vertices @ (light / np.linalg.norm(light)), 0.0, 1.0)
    shaded = colours * (0.45 + 0.6 * lit)[:, None]
    image = np.tile(rng.uniform(0.2, 0.8, 3), (SIZE, SIZE, 1))
    covered = raster.face_id >= 0
    at = faces[raster.face_id[covered]]
    image[covered] = np.einsum("nk,nkc->nc", raster.barycentric[covered], shaded[at])
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
