"""Eye, mouth and ear of the left half: rings of vertices that follow the feature, with their place on the skin chart.

A ring point has two places: `chart`, the point of the smooth head surface that it takes on the UV chart, and `position`,
where it is in the neutral head. They differ where a feature leaves the smooth surface: the ear stands off it, and the
closed mouth is drawn open on the chart, so that upper and lower lip have texels of their own. Millimetres throughout.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar.demo.mesh import EYE_CENTRE, EYE_RADIUS, lip_line
from demo_mesh.sculpt import cast_front, cast_side

EYE_RING_POINTS = 36
MOUTH_QUARTER_POINTS = 16
EAR_RING_POINTS = 26
EAR_CENTRE = np.array([-11.0, 4.0])  # z, y of the side view


class Rings(NamedTuple):
    """R rings of K points each, the innermost first."""

    chart: np.ndarray  # [R, K, 3] on the smooth head surface
    position: np.ndarray  # [R, K, 3]
    level: np.ndarray  # [R] what the ring is: see each function
    closed: bool  # whether the last point of a ring is joined to the first


def eyelid_contour(angle: np.ndarray, widen: float = 0.0) -> np.ndarray:
    """Frontal x, y [..., 2] relative to the eye's centre of the lid margin; 0 is the outer corner, pi/2 the upper lid."""
    c, s = np.cos(angle), np.sin(angle)
    x = np.where(c > 0, 13.9, 13.3) * np.sign(c) * np.abs(c) ** 0.92
    y = np.where(s > 0, 5.9 * np.abs(s) ** 1.05 * (1.0 - 0.12 * c), -4.3 * np.abs(s) ** 1.2 * (1.0 + 0.18 * c))
    y = y + 0.07 * x - 0.2
    normal = np.stack((x / 14.0**2, y / 8.0**2), -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.stack((x, y), -1) + widen * normal


def eye_rings() -> Rings:
    """Levels: -1 inner edge of the lid margin on the eyeball, else the distance from the lid margin in millimetres."""
    angle = np.arange(EYE_RING_POINTS) * (2 * np.pi / EYE_RING_POINTS)
    levels = np.array([-1.0, 0.0, 0.8, 1.9, 3.2, 4.6, 6.4, 8.6])
    chart, position = [], []
    for level in levels:
        xy = EYE_CENTRE[:2] + eyelid_contour(angle, max(level, 0.0))
        if level < 0:
            xy = EYE_CENTRE[:2] + eyelid_contour(angle) * 0.86
        on_skin = cast_front(xy)
        chart.append(on_skin)
        if level >= 0:
            crease = np.clip(np.sin(angle), 0, 1) ** 0.7 * np.exp(-(((level - 3.4) / 1.1) ** 2))
            on_skin = on_skin - np.array([0.0, 0.0, 1.0]) * crease[:, None]
            position.append(on_skin)
    direction = position[0] - EYE_CENTRE
    direction[:, :2] *= 0.97
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    position.insert(0, EYE_CENTRE + direction * (EYE_RADIUS + 0.1))
    return Rings(np.stack(chart), np.stack(position), levels, True)


# Rings of the mouth, from the inside out: (level, half width, upper height, lower height, forward displacement of the
# upper and of the lower lip, opening on the chart). Level 0 is where the lips touch, 1 the border of the vermilion.
_MOUTH = (
    (-2.0, 22.5, 4.0, 4.0, -11.0, -11.0, 0.7),
    (-1.0, 23.6, 1.2, 1.2, -5.0, -5.0, 1.5),
    (0.0, 24.6, 0.1, 0.1, 0.4, 0.6, 2.4),
    (0.18, 24.9, 1.2, 1.6, 2.9, 3.9, 2.5),
    (0.42, 25.2, 2.9, 3.7, 3.8, 5.0, 2.5),
    (0.72, 25.6, 5.0, 6.4, 3.0, 3.7, 2.3),
    (1.0, 26.2, 7.0, 8.7, 1.5, 1.3, 2.0),
    (1.25, 27.2, 8.4, 10.4, 0.6, 0.1, 1.6),
    (1.7, 29.4, 10.8, 13.2, 0.1, 0.0, 1.0),
    (2.4, 33.0, 14.0, 17.0, 0.0, 0.0, 0.4),
)


def mouth_rings() -> Rings:
    """Half rings from the midline over the upper lip to the corner and back under it; see the table for the levels."""
    quarter = np.linspace(0.0, np.pi / 2, MOUTH_QUARTER_POINTS)
    quarter = quarter - 0.06 * np.sin(2 * quarter)
    angle = np.concatenate((quarter, np.pi - quarter[-2::-1]))
    upper = np.arange(len(angle)) < MOUTH_QUARTER_POINTS
    chart, position, levels = [], [], []
    corner = MOUTH_QUARTER_POINTS - 1
    for level, half_width, up, low, out_up, out_low, opening in _MOUTH:
        x = half_width * np.sin(angle)
        x[[0, -1]] = 0.0
        across = np.clip(x / half_width, 0.0, 1.0)
        lip = (1.0 - across**2) ** 0.85
        bow = 1.0 - 0.13 * np.exp(-((x / 3.6) ** 2)) * min(max(level, 0.0), 1.0)
        round_ = np.abs(np.cos(angle))
        blend = np.clip((level - 1.0) / 1.4, 0.0, 1.0)
        shape = (1 - blend) * lip * np.where(upper, bow, 1.0) + blend * round_
        height = np.where(upper, up, -low) * shape
        line = lip_line(x)
        open_shape = np.where(upper, opening, -opening) * (1.0 - across**2) ** 0.5
        depth = np.where(upper, out_up, out_low) * np.where(level < 0, 0.35 + 0.65 * lip, lip**0.6)
        depth = depth - 1.6 * np.exp(-(((1.0 - across) * 7.0) ** 2) - max(level, 0.0) ** 2)
        on_skin = cast_front(np.stack((x, line + height), -1) if level >= 0 else np.stack((x, line), -1))
        point = on_skin + np.stack((np.zeros_like(x), np.zeros_like(x), depth), -1)
        if level < 0:
            point[:, 1] = line + height
        point[corner, 0] = half_width
        position.append(point)
        height_on_chart = np.where(upper, max(up, 0.0), -max(low, 0.0)) * shape if level >= 0 else 0.0
        chart.append(cast_front(np.stack((x, line + height_on_chart + open_shape), -1)))
        levels.append(level)
    return Rings(np.stack(chart), np.stack(position), np.array(levels), False)


# Rings of the ear from the inside out: (level, outline scale, height over the head). Level 1 is the root on the skin.
_EAR = (
    (0.10, 0.16, 0.34),
    (0.22, 0.36, 0.36),
    (0.34, 0.56, 0.62),
    (0.42, 0.68, 0.92),
    (0.50, 0.80, 0.84),
    (0.57, 0.90, 1.02),
    (0.64, 0.98, 1.08),
    (0.71, 1.00, 0.92),
    (0.80, 0.95, 0.62),
    (0.90, 0.87, 0.28),
    (1.00, 0.84, 0.00),
    (1.20, 1.02, 0.00),
)


def ear_rings() -> Rings:
    """The outer ear as a cup: up its back to the helix (level 0.64), over it and down into the concha."""
    angle = np.arange(EAR_RING_POINTS) * (2 * np.pi / EAR_RING_POINTS)  # 0 is forwards (+z), pi/2 is up
    c, s = np.cos(angle), np.sin(angle)
    lobe = np.sign(c) * np.abs(c) ** np.where(s < 0, 0.7, 0.95)
    root = np.stack((11.0 * c, 25.0 * s), -1)  # z, y about the ear's centre
    width = np.where(c > 0, 8.0, 17.0 * (1.0 + 0.25 * s))
    outline = np.stack((width * lobe, np.where(s > 0, 30.0, 31.0 - 5.0 * (c < 0) * np.abs(c)) * s), -1)
    lean = np.radians(12.0)
    turn = np.array([[np.cos(lean), np.sin(lean)], [-np.sin(lean), np.cos(lean)]])
    flare = np.where(c > 0, 4.5 + 3.5 * (1 - np.abs(c)), 8.0 + 8.5 * np.abs(c)) * (1.0 + 0.15 * s)
    flare = flare * (1.0 - 0.45 * np.clip(-s, 0, 1) ** 3)
    foot = cast_side(EAR_CENTRE + root @ turn.T)
    plane, *_ = np.linalg.lstsq(np.column_stack((foot[:, 1:], np.ones(len(foot)))), foot[:, 0], rcond=None)
    chart, position, levels = [], [], []
    for level, scale, height in _EAR:
        base = cast_side(EAR_CENTRE + level * root @ turn.T)
        chart.append(base)
        blend = np.clip((1.0 - level) / 0.29, 0.0, 1.0)
        zy = EAR_CENTRE + ((1 - blend) * level * root + blend * scale * outline) @ turn.T
        # Inside the antihelix the cup's floor keeps about the same distance from the head all around.
        rise = height * (0.45 * flare + 3.2 if level < 0.4 else flare)
        on_plane = np.column_stack((zy[:, 1], zy[:, 0], np.ones(len(zy)))) @ plane
        x = (1 - blend) * base[:, 0] + blend * on_plane + rise
        position.append(np.stack((x, zy[:, 1], zy[:, 0] - 0.25 * rise), -1))
        levels.append(level)
    return Rings(np.stack(chart), np.stack(position), np.array(levels), True)
