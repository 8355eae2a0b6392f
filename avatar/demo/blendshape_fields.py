"""Displacement fields over the head: identity, expression, eyelids. All of them are smooth functions of neutral position.

Fields take points [N, 3] in metres on the neutral head and return displacements [N, 3] in metres for a coefficient of 1.
Identity fields are also applied to what only the renderer has (glasses, teeth), so that it keeps fitting the face.
"""

from __future__ import annotations

import numpy as np

from avatar.demo.mesh import EYE_CENTRE, MOUTH_CENTRE, MOUTH_HALF_WIDTH


def _bump(p: np.ndarray, centre: tuple[float, float, float], radius: float | tuple[float, float, float]) -> np.ndarray:
    """A Gaussian weight [N] about a point of millimetres."""
    offset = (p - np.array(centre)) / np.array(radius)
    return np.exp(-(offset**2).sum(-1))


def _pair(
    p: np.ndarray,
    centre: tuple[float, float, float],
    radius: float | tuple[float, float, float],
    push: tuple[float, float, float],
) -> np.ndarray:
    """The push [N, 3] at a point of the left side and its mirror image on the right (x of the push is outwards)."""
    x, y, z = centre
    left = _bump(p, centre, radius)[:, None] * np.array(push)
    right = _bump(p, (-x, y, z), radius)[:, None] * (np.array(push) * np.array([-1.0, 1.0, 1.0]))
    return left + right


def smooth_step(value: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> np.ndarray:
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _identity_fields(p: np.ndarray) -> dict[str, np.ndarray]:
    """Displacements [N, 3] of points [N, 3] by name, both in millimetres."""
    out: dict[str, np.ndarray] = {}
    out["width"] = p * np.array([0.05, 0.0, 0.0])
    out["height"] = p * np.array([0.0, 0.04, 0.0])
    back = np.minimum(p[:, 2], 0.0)
    out["depth"] = np.stack((0 * back, 0 * back, 0.06 * back), -1)
    front = smooth_step(p[:, 2], -30, 40)
    out["face_length"] = np.stack((0 * front, -5.0 * smooth_step(-p[:, 1], 10, 90) * front, 0 * front), -1)
    jaw = np.exp(-(((p[:, 1] + 62) / 32) ** 2)) * np.exp(-(((p[:, 2] - 22) / 45) ** 2))
    out["jaw_width"] = np.stack((0.11 * p[:, 0] * jaw, 0 * jaw, 0 * jaw), -1)
    top = smooth_step(p[:, 1], 45, 130)
    out["cranium"] = np.stack((0.05 * p[:, 0] * top, 5.0 * top, 0.02 * p[:, 2] * top), -1)
    neck = smooth_step(-p[:, 1], 70, 125)
    out["neck_girth"] = np.stack((0.09 * p[:, 0], 0 * neck, 0.09 * (p[:, 2] + 26)), -1) * neck[:, None]
    out["chin"] = _bump(p, (0, -80, 82), (24, 20, 30))[:, None] * np.array([0.0, -1.5, 5.0])
    out["cheekbones"] = _pair(p, (50, 0, 52), (24, 18, 30), (3.6, 0.5, 2.4))
    out["cheeks"] = _pair(p, (38, -35, 58), (22, 24, 30), (4.6, 0.0, 2.8))
    out["brow_ridge"] = _pair(p, (22, 40, 84), (24, 10, 20), (0.0, -1.2, 3.2))
    out["brow_height"] = _pair(p, (26, 40, 80), (28, 9, 24), (0.0, 2.8, 0.4))
    side = np.tanh(p[:, 0] / 9.0)
    eyes = np.exp(-(((np.abs(p[:, 0]) - 31) / 26) ** 4) - ((p[:, 1] - 22) / 28) ** 4) * smooth_step(p[:, 2], 10, 45)
    out["eye_spacing"] = np.stack((1.6 * side * eyes, 0 * eyes, 0 * eyes), -1)
    out["nose_length"] = _bump(p, (0, -18, 102), (15, 14, 20))[:, None] * np.array([0.0, -3.6, 0.6])
    out["nose_projection"] = _bump(p, (0, -12, 106), (14, 19, 22))[:, None] * np.array([0.0, 0.6, 3.6])
    wings = _bump(p, (0, -17, 96), (20, 11, 17))
    out["nose_width"] = np.stack((0.17 * p[:, 0] * wings, 0 * wings, 0 * wings), -1)
    out["nose_bridge"] = _bump(p, (0, 12, 96), (9, 15, 20))[:, None] * np.array([0.0, 0.0, 3.2])
    mouth = _bump(p, (0, -47, 85), (34, 17, 34))
    out["mouth_width"] = np.stack((0.11 * p[:, 0] * mouth, 0 * mouth, 0 * mouth), -1)
    lips = _bump(p, (0, -48, 96), (20, 12, 16))
    out["lip_fullness"] = np.stack((0 * lips, 0.17 * (p[:, 1] + 47.5) * lips, 2.0 * lips), -1)
    out["ear_flare"] = _pair(p, (88, 8, -22), (15, 34, 18), (4.0, 0.0, 1.0))
    return out


IDENTITY_NAMES = tuple(_identity_fields(np.zeros((1, 3))))


def identity_displacement(points: np.ndarray) -> np.ndarray:
    """Displacements [N, 3, K] in metres of points [N, 3] in metres, one for each of `IDENTITY_NAMES`."""
    return np.stack(list(_identity_fields(points * 1e3).values()), -1) * 1e-3


class Mouth:
    """Weights of the mouth region at the vertices; millimetres."""

    def __init__(self, points: np.ndarray) -> None:
        self.p = points
        self.up = points[:, 1] - MOUTH_CENTRE[1]
        front = smooth_step(points[:, 2], 45, 70)
        self.near = np.exp(-((points[:, 0] / 30) ** 4) - (self.up / 15) ** 4) * front
        self.wide = np.exp(-((points[:, 0] / 48) ** 4) - (self.up / 30) ** 4) * front

    def corner(self, sign: float, reach: float = 15.0) -> np.ndarray:
        """Weight [V] about one mouth corner, 0 on the other half."""
        offset = np.stack((self.p[:, 0] - sign * MOUTH_HALF_WIDTH, self.up), -1) / reach
        return np.exp(-(offset**2).sum(-1)) * smooth_step(self.p[:, 2], 40, 65)


def expression_displacement(points: np.ndarray, lip_side: np.ndarray) -> dict[str, np.ndarray]:
    """Named expressions: displacements [V, 3] in metres at the neutral vertices [V, 3] in metres.

    `lip_side` [V] is 1 on and above the upper lip, -1 on and below the lower lip (the closed lips touch, so position
    alone cannot tell), and fades to 0 elsewhere.
    """
    p = points * 1e3
    m = Mouth(p)
    x, up = p[:, 0], m.up
    zero = np.zeros(len(p))
    upper, lower = np.clip(lip_side, 0, 1), np.clip(-lip_side, 0, 1)
    middle = np.exp(-((x / 17) ** 2))
    out: dict[str, np.ndarray] = {}

    def vector(vx: np.ndarray, vy: np.ndarray, vz: np.ndarray) -> np.ndarray:
        return np.stack(np.broadcast_arrays(vx, vy, vz), -1)

    for name, sign in (("left", 1.0), ("right", -1.0)):
        half = 1.0 / (1.0 + np.exp(-sign * x / 6.0))
        corner, wide = m.corner(sign), m.corner(sign, 26.0)
        cheek = _bump(p, (sign * 42, -14, 66), (20, 17, 28))
        fold = _bump(p, (sign * 30, -30, 80), (9, 13, 22))
        out[f"smile_{name}"] = (
            vector(sign * 6.0 * corner + sign * 2.2 * wide, 5.2 * corner + 2.0 * wide, -4.2 * corner - 1.2 * wide)
            + vector(sign * 0.8 * cheek, 2.8 * cheek, 2.8 * cheek)
            + vector(zero, zero, 1.4 * fold)
        )
        out[f"frown_{name}"] = vector(sign * 1.0 * corner, -5.0 * corner - 1.6 * wide, -1.0 * corner)
        out[f"stretch_{name}"] = vector(sign * 5.0 * corner + sign * 1.6 * wide, -1.2 * corner, -3.4 * corner)
        out[f"dimple_{name}"] = vector(sign * 2.0 * corner, 0.4 * corner, -4.5 * corner)
        lip = m.near * half
        out[f"upper_lip_up_{name}"] = vector(zero, 4.0 * lip * upper, 1.0 * lip * upper)
        out[f"lower_lip_down_{name}"] = vector(zero, -4.2 * lip * lower, -0.4 * lip * lower)
        wing = _bump(p, (sign * 13, -18, 94), (9, 10, 14))
        side = _bump(p, (sign * 12, 0, 92), (8, 14, 14))
        out[f"sneer_{name}"] = vector(
            sign * 1.2 * wing, 3.4 * wing + 1.6 * side + 2.0 * lip * upper, 0.9 * wing + 1.2 * side
        )
        out[f"cheek_up_{name}"] = vector(
            zero, 4.0 * cheek + 1.4 * _bump(p, (sign * 32, 9, 76), (16, 7, 18)), 3.0 * cheek
        )
        brow_in = _bump(p, (sign * 14, 40, 88), (14, 13, 24))
        brow_out = _bump(p, (sign * 40, 40, 74), (19, 14, 28))
        above = _bump(p, (sign * 26, 62, 86), (26, 20, 32))
        out[f"brow_inner_up_{name}"] = vector(zero, 6.4 * brow_in + 1.6 * above, 0.6 * brow_in)
        out[f"brow_outer_up_{name}"] = vector(zero, 6.0 * brow_out + 1.6 * above, 0.4 * brow_out)
        out[f"brow_down_{name}"] = vector(
            -sign * 2.2 * brow_in, -4.2 * brow_in - 2.2 * brow_out, 1.6 * brow_in + 0.4 * brow_out
        )
        eye = p - EYE_CENTRE * np.array([sign, 1.0, 1.0])
        lid = np.exp(-((eye[:, 0] / 15) ** 4)) * np.exp(-(((eye[:, 2] - 11) / 9) ** 2))
        below = np.exp(-(((eye[:, 1] + 7) / 4.5) ** 2)) * lid
        over = np.exp(-(((eye[:, 1] - 8) / 4.0) ** 2)) * lid
        out[f"squint_{name}"] = vector(zero, 2.0 * below - 1.0 * over, 0.9 * below + 0.4 * over)

    pull = m.near * (0.35 + 0.65 * np.exp(-((up / 9) ** 2)))
    out["pucker"] = vector(-0.36 * x * pull, -0.10 * up * m.near, 6.0 * middle * m.near + 1.0 * m.wide)
    out["funnel"] = vector(
        -0.24 * x * pull, 3.4 * upper * m.near * middle - 3.8 * lower * m.near * middle, 5.0 * middle * m.near
    )
    rolled = np.exp(-((up / 7) ** 2)) * m.near
    out["lip_press"] = vector(zero, (-1.3 * upper + 1.5 * lower) * rolled, -2.2 * rolled)
    out["lip_roll_in"] = vector(zero, (-0.8 * upper + 0.8 * lower) * rolled, -4.0 * rolled * middle)
    out["chin_raise"] = vector(
        zero, 3.2 * _bump(p, (0, -72, 88), (20, 16, 24)) + 2.2 * lower * m.near, 1.6 * _bump(p, (0, -66, 90), 14)
    )
    out["mouth_left"] = vector(6.0 * m.near + 1.6 * m.wide, zero, -0.05 * x * m.near)
    out["lower_lip_thrust"] = vector(zero, 0.6 * lower * m.near, 3.4 * lower * m.near * middle)
    out["cheek_puff"] = _pair(p, (40, -38, 66), (17, 19, 26), (5.0, 0.0, 4.0))
    out["jaw_back"] = vector(zero, zero, -3.0 * smooth_step(-p[:, 1], 52, 80) * smooth_step(p[:, 2], 10, 60))
    return {name: field * 1e-3 for name, field in out.items()}
