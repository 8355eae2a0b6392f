"""Pictures of random heads of a head model, in plain colours, good enough for a face landmarker to find its points."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from avatar.head.assets import HeadAssets
from avatar.head.model import LEFT_EYE, RIGHT_EYE, HeadModel
from avatar.head.normals import vertex_normals
from avatar.head.rasterize import rasterize_mesh
from avatar.types import HeadParams
from data_prep.track.fit.expression_kind import is_statistical, used_expressions
from data_prep.track.fit.frame_poses import gaze_rotations, rotations

SIZE = 384  # pixels, the whole picture
EYE_DISTANCE = 78.0  # pixels between the eyes' centres of a head seen from in front
CAMERA_DISTANCE = 14.0  # in distances between the eyes: 0.9 m
POSE_SPREAD = np.radians([5.0, 9.0, 4.0])  # pitch, yaw, roll
POSE_LIMIT = np.radians([20.0, 34.0, 12.0])
_SKIN = np.array([[0.87, 0.68, 0.58], [0.80, 0.58, 0.47], [0.66, 0.46, 0.36], [0.48, 0.32, 0.24]])  # sRGB
_IRIS_ANGLE, _PUPIL_ANGLE = np.radians(28.0), np.radians(12.0)  # from the eye's axis
# In distances between the eyes, from the eye's centre: as FLAME's embedding has them.
_BROW_UP, _BROW_BEND, _BROW_HALF_HEIGHT, _BROW_REACH = 0.31, 0.4, 0.04, 0.34
_HAIR = np.array([[0.10, 0.08, 0.07], [0.22, 0.15, 0.10], [0.45, 0.32, 0.20], [0.55, 0.53, 0.50]])  # sRGB
_GAMMA = 2.2
_SKY_DIRECTIONS, _SKY_SIZE = 96, 320
_INSIDE = np.array([0.02, 0.004, 0.003])  # linear
_FLIP = np.diag([1.0, -1.0, -1.0])  # head axes (y up, z forward) in front of an OpenCV camera


class TintedHead(NamedTuple):
    image: np.ndarray  # uint8 [SIZE, SIZE, 3]
    screen: np.ndarray  # float64 [V, 3] pixels and depth of the vertices
    is_visible: np.ndarray  # bool [V]


def render_tinted_heads(assets: HeadAssets, count: int) -> Iterator[TintedHead]:
    """`count` random identities with random expressions, poses, skin and light; always the same ones."""
    rng = np.random.default_rng(0)
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
        turn = (turn[0] @ turn[1] @ turn[2]).numpy()
        screen = _project(assets, vertices, turn)
        raster = rasterize_mesh(screen, faces, SIZE, SIZE)
        with_hair = _project(assets, _raised(vertices, faces, paint.hair * rng.uniform(0.05, 0.3) * paint.unit), turn)
        colours = paint(rng)
        yield TintedHead(
            _shade(with_hair, faces, colours, paint.sky, rng), screen, visible_vertices(raster.depth, screen)
        )


def visible_vertices(depth: np.ndarray, screen: np.ndarray, tolerance: float = 3e-3) -> np.ndarray:
    """[V] whether a vertex lies in the picture and not, by `tolerance` metres, behind what the z-buffer [H, W] holds."""
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
    """Colours of the vertices: skin, hair, brows, lips, eyes."""

    def __init__(self, assets: HeadAssets) -> None:
        template, weights = assets.template.numpy(), assets.weights.numpy()
        centres = (assets.joint_regressor @ assets.template).numpy()[[LEFT_EYE, RIGHT_EYE]]
        self.unit = float(np.linalg.norm(centres[0] - centres[1]))
        V = len(template)
        self.lips = np.zeros(V, bool)
        if "lips" in assets.regions:
            self.lips[assets.regions["lips"].numpy()] = True
        self.sky = _open_sky(template.astype(np.float64), assets.faces.numpy(), self.unit)
        self.hair = _hair((template - centres.mean(0)) / self.unit)
        self.brows = np.zeros(V)
        self.eyes, self.iris, self.pupil = (np.zeros(V, bool) for _ in range(3))
        for joint, centre in zip((LEFT_EYE, RIGHT_EYE), centres, strict=True):
            offset = (template - centre) / self.unit
            ball = weights[:, joint] > 0.5
            angle = np.arctan2(np.hypot(offset[:, 0], offset[:, 1]), offset[:, 2])
            self.eyes |= ball
            self.iris |= ball & (angle < _IRIS_ANGLE)
            self.pupil |= ball & (angle < _PUPIL_ANGLE)
            arch = _BROW_UP - _BROW_BEND * offset[:, 0] ** 2
            brow = np.exp(-(((offset[:, 1] - arch) / _BROW_HALF_HEIGHT) ** 2)) * (np.abs(offset[:, 0]) < _BROW_REACH)
            self.brows = np.maximum(self.brows, np.where(offset[:, 2] > -0.2, brow, 0.0))

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        """float64 [V, 3]; another skin, other hair, lips, brows and eyes each time."""
        tone = rng.uniform(0, len(_SKIN) - 1)
        below = min(int(tone), len(_SKIN) - 2)
        skin = (_SKIN[below] + (tone - below) * (_SKIN[below + 1] - _SKIN[below])) * rng.uniform(0.9, 1.1, 3)
        hair = _HAIR[rng.integers(len(_HAIR))]
        colours = np.tile(skin, (len(self.lips), 1))
        colours[self.lips] = skin * np.array([0.92, 0.62, 0.62]) * rng.uniform(0.85, 1.0)
        colours += self.hair[:, None] * (hair - colours)
        colours += (self.brows * rng.uniform(0.5, 0.9))[:, None] * (0.8 * hair - colours)
        colours[self.eyes] = 0.93
        colours[self.iris] = np.array([[0.30, 0.19, 0.10], [0.25, 0.36, 0.48], [0.24, 0.32, 0.20]])[rng.integers(3)]
        colours[self.pupil] = 0.04
        return colours


def _open_sky(points: np.ndarray, faces: np.ndarray, unit: float) -> np.ndarray:
    """How much of the light from all sides arrives at each vertex [V]: 1 on open ground, dark in nostrils and folds."""
    normals = _normals(points, faces)
    span = 2.2 * np.ptp(points, axis=0).max() / 2
    arrived, possible = np.zeros(len(points)), np.full(len(points), 1e-9)
    golden = np.pi * (3.0 - np.sqrt(5.0))
    for k in range(_SKY_DIRECTIONS):
        z = 1.0 - (2 * k + 1) / _SKY_DIRECTIONS
        r = np.sqrt(1.0 - z * z)
        towards = np.array([r * np.cos(golden * k), r * np.sin(golden * k), z])
        side = np.cross(towards, [0.3, 1.0, 0.2])
        side /= np.linalg.norm(side)
        view = np.stack((side, np.cross(towards, side), -towards))  # rows: right, down, away
        p = (points - points.mean(0)) @ view.T
        screen = np.stack(((p[:, 0] / span + 0.5) * _SKY_SIZE, (p[:, 1] / span + 0.5) * _SKY_SIZE, p[:, 2] + 1.0), -1)
        depth = rasterize_mesh(screen, faces, _SKY_SIZE, _SKY_SIZE).depth
        cosine = np.clip(normals @ towards, 0.0, None)
        possible += cosine
        arrived += cosine * visible_vertices(depth, screen, 0.02 * unit)
    return arrived / possible


def _hair(p: np.ndarray) -> np.ndarray:
    """How far [V] a vertex is under hair, 0 to 1; `p` is relative to the middle between the eyes, in their distance.

    Above a line that runs from the hairline in front, over the temples and above the ears, down to the nape.
    """
    front, back = 1.0, -0.9  # heights of the hairline
    along = np.clip((0.25 - p[:, 2]) / 2.2, 0.0, 1.0)  # from the forehead to the back of the head
    line = front + (back - front) * along**1.5
    return np.clip((p[:, 1] - line) / 0.12 + 0.5, 0.0, 1.0)


def _raised(vertices: np.ndarray, faces: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Vertices moved along their normals, metres."""
    return vertices + height[:, None] * _normals(vertices, faces)


def _normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return vertex_normals(torch.from_numpy(points), torch.from_numpy(faces)).numpy()


def _shade(
    screen: np.ndarray, faces: np.ndarray, colours: np.ndarray, sky: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Light from all sides, a lamp in front and its reflection on the skin; what is seen from inside is dark."""
    raster = rasterize_mesh(screen, faces, SIZE, SIZE)
    # With depth in the scale of the pixels, the picture's own space is near enough to a Euclidean one for the light.
    in_pixels = screen * np.array([1.0, 1.0, EYE_DISTANCE * CAMERA_DISTANCE / np.median(screen[:, 2])])
    normals = _normals(in_pixels, faces)
    light = np.array([rng.uniform(-0.7, 0.7), rng.uniform(-0.6, 0.5), -1.0])  # towards the light; y points down, z away
    light /= np.linalg.norm(light)
    lit = np.clip(normals @ light, 0.0, 1.0) * sky
    halfway = (light + np.array([0.0, 0.0, -1.0])) / np.linalg.norm(light + np.array([0.0, 0.0, -1.0]))
    gloss = rng.uniform(0.0, 0.2) * np.clip(normals @ halfway, 0.0, 1.0) ** 20 * sky
    shaded = colours**_GAMMA * (0.5 * sky + 0.55 * lit)[:, None] + gloss[:, None]
    image = np.tile(rng.uniform(0.1, 0.6, 3), (SIZE, SIZE, 1))
    covered = raster.face_id >= 0
    at = faces[raster.face_id[covered]]
    seen = np.einsum("nk,nkc->nc", raster.barycentric[covered], shaded[at])
    a, b = screen[at[:, 1], :2] - screen[at[:, 0], :2], screen[at[:, 2], :2] - screen[at[:, 0], :2]
    inside_out = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0  # outside, corners run counter-clockwise; y points down
    seen[inside_out] = _INSIDE
    image[covered] = seen
    return np.rint(np.clip(image, 0, 1) ** (1 / _GAMMA) * 255).astype(np.uint8)
