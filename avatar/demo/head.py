"""The demo head as a complete FLAME-format model: template, bases, joints, weights, eyelids, regions, UVs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from avatar.demo.blendshape_fields import expression_displacement, identity_displacement, smooth_step
from avatar.demo.mesh import EYE_CENTRE, EYE_RADIUS, MOUTH_HALF_WIDTH, HeadMesh, lip_line, load_head_mesh

# Metres; FLAME's joints: root at the base of the neck, neck (which carries the head), jaw, left eye, right eye.
JOINTS = (
    np.array(
        [
            [0.0, -130.0, -34.0],
            [0.0, -78.0, -30.0],
            [0.0, -6.0, -6.0],
            EYE_CENTRE,
            EYE_CENTRE * np.array([-1.0, 1.0, 1.0]),
        ]
    )
    * 1e-3
)
PARENTS = (-1, 0, 1, 1, 1)
NUM_IDENTITY, NUM_EXPRESSION = 300, 100  # FLAME's slots; the demo fills the first few of each


@dataclass(frozen=True)
class DemoHead:
    """The generic head, float32 unless said otherwise; metres."""

    mesh: HeadMesh
    template: np.ndarray  # [V, 3]
    identity_dirs: np.ndarray  # [V, 3, I]
    expression_dirs: np.ndarray  # [V, 3, E]
    expression_names: tuple[str, ...]
    pose_dirs: np.ndarray  # [V, 3, 36], FLAME's order: the nine values of R - I of neck, jaw, left eye, right eye
    joint_regressor: np.ndarray  # [5, V]
    weights: np.ndarray  # [V, 5]
    eyelid_dirs: np.ndarray  # [2, V, 3] left, right
    regions: dict[str, np.ndarray]  # int64 vertex indices


@cache
def demo_head() -> DemoHead:
    """The head; made once per process, the same bits every time."""
    mesh = load_head_mesh()
    points = mesh.vertices
    skin = np.ones(len(points), bool)
    skin[np.concatenate(mesh.eyeballs)] = False
    side = _lip_side(mesh)
    identity = identity_displacement(points)
    for ball, centre in zip(mesh.eyeballs, JOINTS[3:], strict=True):
        identity[ball] = identity_displacement(centre[None])
    expressions = expression_displacement(points, side)
    expression = np.stack(list(expressions.values()), -1)
    expression[~skin] = 0.0
    eyelids = _eyelids(mesh)
    return DemoHead(
        mesh=mesh,
        template=points.astype(np.float32),
        identity_dirs=identity.astype(np.float32),
        expression_dirs=expression.astype(np.float32),
        expression_names=tuple(expressions),
        pose_dirs=_pose_dirs(points, skin, eyelids).astype(np.float32),
        joint_regressor=_joint_regressor(mesh, skin).astype(np.float32),
        weights=_weights(mesh, side).astype(np.float32),
        eyelid_dirs=eyelids.astype(np.float32),
        regions=_regions(mesh, skin),
    )


def _lip_side(mesh: HeadMesh) -> np.ndarray:
    p = mesh.vertices * 1e3
    side = np.tanh((p[:, 1] - lip_line(np.clip(p[:, 0], -MOUTH_HALF_WIDTH, MOUTH_HALF_WIDTH))) / 2.5)
    # The vermilion and the inside of the lips, where height says little: by the ring's own order, 0 in the corner.
    rings = mesh.mouth_rings[:, :7]
    order = np.linspace(1.0, -1.0, rings.shape[-1])
    side[rings] = np.broadcast_to(
        np.sign(order) * np.sin(np.abs(order) * np.pi / 2) ** np.where(order > 0, 0.7, 0.5), rings.shape
    )
    return side


def _eyelids(mesh: HeadMesh) -> np.ndarray:
    """[2, V, 3] displacements that bring the upper lid down onto the (slightly raised) lower lid."""
    out = np.zeros((2, len(mesh.vertices), 3))
    for k, (sign, rings) in enumerate(zip((1.0, -1.0), mesh.eye_rings, strict=True)):
        centre = EYE_CENTRE * np.array([sign, 1.0, 1.0])
        points = mesh.vertices * 1e3 - centre
        elevation = np.arctan2(points[:, 1], points[:, 2])
        # The margin in the ring's order: outer corner, upper lid, inner corner, lower lid, outer corner.
        margin = np.append(rings[1], rings[1][0])
        inner = len(rings[1]) // 2
        upper_at = _elevation_along(margin[: inner + 1], points, elevation)
        lower_at = _elevation_along(margin[inner:], points, elevation)
        meet = lower_at + 0.16 * (upper_at - lower_at)
        inside = np.exp(-((np.abs(points[:, 0]) / 17.5) ** 8))
        above, below = elevation - upper_at, lower_at - elevation
        middle = 0.5 * (upper_at + lower_at)
        is_top = elevation > middle
        down = (meet - upper_at) * np.where(is_top, 1.0 - smooth_step(above, 0.02, 0.52), 0.0)
        rise = (meet - lower_at) * np.where(~is_top, 1.0 - smooth_step(below, 0.02, 0.45), 0.0)
        distance = np.linalg.norm(points, axis=-1)
        turn = (down + rise) * inside * (1.0 - smooth_step(distance, 15.8, 21.0))
        # Rotate about the eye's left-right axis, and keep the lid a little outside the eyeball and the cornea.
        radius = np.hypot(points[:, 1], points[:, 2])
        angle = elevation + turn
        moved = np.stack((points[:, 0], radius * np.sin(angle), radius * np.cos(angle)), -1)
        length = np.linalg.norm(moved, axis=-1, keepdims=True)
        wanted = np.maximum(length, EYE_RADIUS + 0.9)
        moved = moved * (1 + (wanted / np.maximum(length, 1e-9) - 1) * np.minimum(np.abs(turn) / 0.15, 1.0)[:, None])
        shift = np.where((points[:, 2] > -2.0)[:, None], moved - points, 0.0)
        shift[np.concatenate(mesh.eyeballs)] = 0.0
        out[k] = shift * 1e-3
    return out


def _elevation_along(line: np.ndarray, points: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """The elevation [V] of a lid's margin (vertex indices `line`) above or below each point's x."""
    line = line[np.argsort(points[line, 0])]
    return np.interp(points[:, 0], points[line, 0], elevation[line])


def _pose_dirs(points: np.ndarray, skin: np.ndarray, eyelids: np.ndarray) -> np.ndarray:
    """What the rotations do beside rotating: the opening jaw narrows the mouth, the upper lids follow the gaze."""
    p = points * 1e3
    x, up = p[:, 0], p[:, 1] + 47.5
    front = smooth_step(p[:, 2], 30, 65)
    corner = np.exp(-(((np.abs(x) - 25) / 15) ** 2) - (up / 16) ** 2) * front
    cheek = np.exp(-(((np.abs(x) - 44) / 18) ** 2) - ((p[:, 1] + 38) / 24) ** 2) * front
    jaw = np.stack((-np.sign(x) * (9.0 * corner + 5.0 * cheek), 2.0 * corner, -1.0 * corner - 4.0 * cheek), -1) * 1e-3
    jaw[~skin] = 0.0
    pose = np.zeros((len(p), 3, 36))
    for joint, per_radian in ((1, jaw), (2, 0.85 * eyelids[0]), (3, 0.85 * eyelids[1])):
        # A turn about x by a has sin(a) in entry (2, 1) of the matrix and -sin(a) in entry (1, 2).
        pose[:, :, 9 * joint + 7] = 0.5 * per_radian
        pose[:, :, 9 * joint + 5] = -0.5 * per_radian
    return pose


def _joint_regressor(mesh: HeadMesh, skin: np.ndarray) -> np.ndarray:
    """Rows that sum to one and give the joints exactly: the weights of least norm over each joint's own vertices."""
    regressor = np.zeros((5, len(mesh.vertices)))
    for j, joint in enumerate(JOINTS):
        if j >= 3:
            own = mesh.eyeballs[j - 3]
        else:
            distance = np.linalg.norm(mesh.vertices - joint, axis=-1)
            own = np.flatnonzero(skin & (distance < np.sort(distance[skin])[400]))
            own = np.unique(np.concatenate((own, mesh.mirror[own])))
        system = np.concatenate((mesh.vertices[own].T, np.ones((1, len(own)))))
        regressor[j, own] = np.linalg.lstsq(system, np.append(joint, 1.0), rcond=None)[0]
    return regressor


def _weights(mesh: HeadMesh, side: np.ndarray) -> np.ndarray:
    p = mesh.vertices * 1e3
    below = (-4.0 - 0.50 * (p[:, 2] + 8.0)) - p[:, 1]  # under the line from the jaw joint to the mouth's corner
    jaw = smooth_step(below, -13.0, 16.0)
    up = p[:, 1] + 47.5
    mouth = np.exp(-((p[:, 0] / 29) ** 4) - (up / 15) ** 4) * smooth_step(p[:, 2], 55, 75)
    jaw = mouth * (0.5 - 0.5 * side) + (1.0 - mouth) * jaw
    jaw = jaw * smooth_step(p[:, 2] + 0.25 * (p[:, 1] + 60.0), -2.0, 38.0)
    jaw = jaw * smooth_step(p[:, 1] + 0.6 * (p[:, 2] - 30.0), -122.0, -88.0)
    head = smooth_step(p[:, 1], -135.0, -85.0)
    weights = np.zeros((len(p), 5))
    weights[:, 2] = jaw
    weights[:, 1] = (1.0 - jaw) * head
    weights[:, 0] = (1.0 - jaw) * (1.0 - head)
    for joint, ball in zip((3, 4), mesh.eyeballs, strict=True):
        weights[ball] = 0.0
        weights[ball, joint] = 1.0
    return weights


def _regions(mesh: HeadMesh, skin: np.ndarray) -> dict[str, np.ndarray]:
    p = mesh.vertices * 1e3
    ear = np.zeros(len(p), bool)
    ear[mesh.ear_rings[:, :-1]] = True
    jaw_line = -68.0 - 0.42 * (p[:, 2] - 20.0)
    scalp = skin & ~ear & (p[:, 1] > 86.0 - 0.0075 * np.clip(62.0 - p[:, 2], 0, None) ** 2 - 12.0 * (p[:, 2] < 0))
    neck = skin & ~ear & (p[:, 1] < np.minimum(jaw_line, -36.0 - 0.5 * (p[:, 2] + 60.0)))
    neck &= (p[:, 2] < 30.0) | (p[:, 1] < -100.0)
    face = skin & ~ear & ~scalp & ~neck & (p[:, 2] > 8.0)
    return {
        "boundary": mesh.rim,
        "face": np.flatnonzero(face),
        "lips": np.unique(mesh.mouth_rings[:, :7]),
        "left_eyeball": mesh.eyeballs[0],
        "right_eyeball": mesh.eyeballs[1],
        "left_ear": np.unique(mesh.ear_rings[0, :-1]),
        "right_ear": np.unique(mesh.ear_rings[1, :-1]),
        "neck": np.flatnonzero(neck),
        "scalp": np.flatnonzero(scalp & ~neck),
    }
