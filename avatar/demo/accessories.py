"""What only the renderer has, and the tracked head model has not: teeth, gums, tongue, mouth cavity, glasses, clothes.

Built in millimetres on the generic head, then carried to the person by the same identity fields as the skin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar.demo.blendshape_fields import smooth_step
from avatar.demo.identity import Identity


class Prop(NamedTuple):
    """A coloured mesh: points [N, 3] in millimetres, faces [F, 3], linear colours [N, 3]."""

    points: np.ndarray
    faces: np.ndarray
    colours: np.ndarray


def grid_faces(rows: int, columns: int, wrap: bool = False) -> np.ndarray:
    """Triangles [F, 3] of a grid of points stored row by row; `wrap` joins the last column to the first."""
    across = columns if wrap else columns - 1
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(across), indexing="ij")
    a, b = (r * columns + c).ravel(), (r * columns + (c + 1) % columns).ravel()
    return np.concatenate((np.stack((a, b, b + columns), -1), np.stack((a, b + columns, a + columns), -1)))


def join(props: list[Prop]) -> Prop:
    """One mesh of several."""
    starts = np.cumsum([0] + [len(p.points) for p in props[:-1]])
    return Prop(
        np.concatenate([p.points for p in props]),
        np.concatenate([p.faces + s for p, s in zip(props, starts, strict=True)]),
        np.concatenate([p.colours for p in props]),
    )


def _tooth_row(upper: bool) -> Prop:
    """A dental arch as one strip, from the gums to the cutting edge and a little round its back."""
    widths = np.array([8.6, 6.6, 7.6, 7.0, 7.0, 9.0]) if upper else np.array([5.6, 6.0, 6.9, 7.0, 7.2, 9.5])
    lengths = np.array([9.6, 9.0, 9.3, 8.6, 8.3, 8.0]) if upper else np.array([8.4, 8.5, 8.7, 8.4, 8.2, 8.0])
    run = np.concatenate(([0.0], np.cumsum(widths)))
    s = np.linspace(-run[-1] * 0.98, run[-1] * 0.98, 151)
    tooth = np.clip(np.searchsorted(run, np.abs(s), side="right") - 1, 0, len(widths) - 1)
    phase = (np.abs(s) - run[tooth]) / widths[tooth]  # 0 to 1 across a tooth
    bulge = np.sqrt(np.clip(1.0 - (2 * phase - 1) ** 2, 0, 1))
    # The arch: half an ellipse, about by arc length.
    turn = s / (run[-1] * 0.98) * 1.45
    half_width, depth, front = (23.5, 34.0, 83.5) if upper else (21.0, 31.0, 80.5)
    x, z = half_width * np.sin(turn), front - depth * (1 - np.cos(turn))
    outward = np.stack((np.sin(turn) / half_width, np.cos(turn) / depth), -1)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    t = np.array([-0.45, 0.0, 0.06, 0.3, 0.6, 0.85, 0.97, 1.0, 0.93, 0.6])  # share of the crown; below 0 is gum
    thickness = np.array([0.6, 0.9, 0.2, 1.0, 1.2, 0.8, 0.2, -0.9, -2.2, -3.4])
    length = lengths[tooth] * (1 - 0.10 * (1 - bulge) ** 2)
    edge = -49.3 if upper else -49.0
    sign = -1.0 if upper else 1.0
    y = edge - sign * lengths[0] + sign * t[:, None] * length[None]
    swell = thickness[:, None] + np.where(t[:, None] > 0.02, 1.0 * (bulge - 1.0)[None], -0.2)
    points = np.stack((x + swell * outward[:, 0], y, z + swell * outward[:, 1]), -1)
    enamel = np.array([0.74, 0.69, 0.60])
    gum = np.array([0.36, 0.12, 0.11])
    is_gum = (t < 0.03)[:, None, None]
    gap = (0.35 + 0.65 * smooth_step(bulge, 0.0, 0.42))[None, :, None]
    back = 1.0 - 0.62 * smooth_step(np.abs(turn), 0.35, 1.25)[None, :, None]
    colours = np.where(is_gum, gum, enamel * gap * (0.88 + 0.12 * t[:, None, None])) * back
    faces = grid_faces(len(t), len(s))
    return Prop(points.reshape(-1, 3), faces if upper else faces[:, ::-1], colours.reshape(-1, 3))


def _ellipsoid(
    centre: tuple[float, float, float], radii: tuple[float, float, float], colour: np.ndarray, inward: bool = False
) -> Prop:
    polar, turn = np.linspace(0, np.pi, 14), np.arange(24) * (2 * np.pi / 24)
    p, t = np.meshgrid(polar, turn, indexing="ij")
    unit = np.stack((np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)), -1).reshape(-1, 3)
    faces = grid_faces(14, 24, wrap=True)
    points = unit * np.array(radii) + np.array(centre)
    return Prop(points, faces[:, ::-1] if inward else faces, np.broadcast_to(colour, points.shape).copy())


def upper_mouth() -> Prop:
    """Upper teeth and the dark back of the mouth: fixed to the skull."""
    cavity = _ellipsoid((0, -50, 46), (31, 25, 30), np.array([0.055, 0.014, 0.012]), inward=True)
    front = smooth_step(cavity.points[:, 2], 52, 74)[:, None]
    return join([_tooth_row(True), cavity._replace(colours=cavity.colours * (1 + 1.2 * front))])


def lower_mouth() -> Prop:
    """Lower teeth and the tongue: they turn with the jaw."""
    tongue = _ellipsoid((0, -58.5, 52), (19, 7.5, 25), np.array([0.30, 0.085, 0.08]))
    groove = np.exp(-((tongue.points[:, 0] / 2.5) ** 2)) * (tongue.points[:, 1] > -58)
    tongue.points[:, 1] -= 1.2 * groove
    return join([_tooth_row(False), tongue])


def _tube(path: np.ndarray, radius: np.ndarray, closed: bool, colour: np.ndarray) -> Prop:
    sides = 8
    ahead = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    if not closed:
        ahead[0], ahead[-1] = path[1] - path[0], path[-1] - path[-2]
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    up = np.where(np.abs(ahead[:, 2:]) > 0.8, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    a = np.cross(ahead, up)
    a /= np.linalg.norm(a, axis=-1, keepdims=True)
    b = np.cross(ahead, a)
    turn = np.arange(sides) * (2 * np.pi / sides)
    ring = path[:, None] + radius[:, :1, None] * np.cos(turn)[None, :, None] * a[:, None]
    ring = ring + radius[:, 1:, None] * np.sin(turn)[None, :, None] * b[:, None]
    if closed:
        ring = np.concatenate((ring, ring[:1]))
    points = ring.reshape(-1, 3)
    faces = grid_faces(len(ring), sides, wrap=True)
    return Prop(points, faces, np.broadcast_to(colour, points.shape).copy())


def _rim(identity: Identity, side: float, turn: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Points [N, 3] of a lens' outline; the glasses wrap a little round the face."""
    power = 2.0 / identity.glasses_roundness
    c, s = np.cos(turn), np.sin(turn)
    x = 33.5 + scale * 25.5 * np.sign(c) * np.abs(c) ** power
    y = 16.5 + scale * (19.5 + 1.5 * c) * np.sign(s) * np.abs(s) ** power
    return np.stack((side * x, y, 99.5 - 0.0042 * x**2 + 0.06 * (y - 16)), -1)


def glasses_frame(identity: Identity) -> Prop:
    """Rims, bridge and temples."""
    turn = np.arange(56) * (2 * np.pi / 56)
    parts = []
    for side in (1.0, -1.0):
        rim = _rim(identity, side, turn)
        parts.append(_tube(rim, np.full((56, 2), 1.35), True, identity.frame_colour))
        x, y, z = _rim(identity, side, np.array([0.42]))[0]
        temple = np.array(
            [
                [x, y, z],
                [x + side * 3.5, y + 0.5, z - 4.0],
                [side * 74, 27, 36],
                [side * 79, 29, -4],
                [side * 80, 22, -17],
                [side * 79, 4, -25],
            ]
        )
        knots = np.linspace(0, 1, len(temple))
        fine = np.linspace(0, 1, 26)
        path = np.stack([np.interp(fine, knots, temple[:, k]) for k in range(3)], -1)
        path[1:-1] = (path[:-2] + 2 * path[1:-1] + path[2:]) / 4
        parts.append(_tube(path, np.full((26, 2), 1.25), False, identity.frame_colour))
    nose = np.linspace(-1, 1, 15)
    left_edge = _rim(identity, 1.0, np.array([np.pi - 0.35]))[0]
    bridge = np.stack((nose * left_edge[0], left_edge[1] + 2.2 * (1 - nose**2), left_edge[2] + 3.0 * (1 - nose**2)), -1)
    parts.append(_tube(bridge, np.full((15, 2), 1.35), False, identity.frame_colour))
    return join(parts)


def glasses_lenses(identity: Identity) -> Prop:
    """Two thin curved sheets, drawn as a reflection over what is behind them."""
    turn, scales = np.arange(40) * (2 * np.pi / 40), np.linspace(1.0, 0.0, 7)
    parts = []
    for side in (1.0, -1.0):
        rings = np.concatenate([_rim(identity, side, turn, s) for s in scales])
        rings[:, 2] += np.repeat(1.8 * (1 - scales**2), 40)
        faces = grid_faces(len(scales), 40, wrap=True)
        parts.append(Prop(rings, faces if side > 0 else faces[:, ::-1], np.ones_like(rings)))
    return join(parts)


def shirt(identity: Identity) -> Prop:
    """Collar and shoulders, from inside the collar out and down; open at the bottom, below the picture."""
    turn = np.arange(72) * (2 * np.pi / 72)  # 0 is +x, pi/2 is +z
    # half width, half depth, centre z, height at the front, at the sides, at the back; superellipse power
    rows = np.array(
        [
            (52, 49, -32, -150, -140, -122, 2.0),
            (57, 55, -31, -140, -129, -112, 2.0),
            (60, 58, -30, -136, -125, -108, 2.0),
            (63, 61, -30, -137, -126, -110, 2.0),
            (66, 64, -30, -143, -131, -117, 2.0),
            (80, 72, -32, -155, -139, -130, 2.0),
            (108, 80, -36, -172, -149, -142, 2.1),
            (140, 88, -40, -192, -161, -156, 2.2),
            (166, 96, -42, -214, -176, -176, 2.3),
            (182, 103, -42, -240, -200, -205, 2.4),
            (190, 108, -42, -280, -245, -250, 2.4),
            (194, 112, -42, -360, -330, -330, 2.4),
        ]
    )
    c, s = np.cos(turn), np.sin(turn)
    points = []
    for half_x, half_z, centre_z, front, side, back, power in rows:
        x = half_x * np.sign(c) * np.abs(c) ** (2 / power)
        z = centre_z + half_z * np.sign(s) * np.abs(s) ** (2 / power)
        y = side * c**2 + np.where(s > 0, front, back) * s**2
        points.append(np.stack((x, y, z), -1))
    fine = np.linspace(0, len(rows) - 1, 3 * len(rows) - 2)
    base = np.array(points)
    low = np.minimum(fine.astype(int), len(rows) - 2)
    part = (fine - low)[:, None, None]
    grid = base[low] * (1 - part) + base[low + 1] * part
    grid[1:-1] = 0.25 * grid[:-2] + 0.5 * grid[1:-1] + 0.25 * grid[2:]
    weave = 1.0 + 0.03 * np.random.default_rng((identity.seed, 8)).standard_normal(grid.shape[:2])
    band = np.where((fine > 0.5) & (fine < 3.8), 0.82, 1.0)[:, None]
    colours = (weave * band)[..., None] * identity.shirt_colour
    return Prop(grid.reshape(-1, 3), grid_faces(len(fine), 72, wrap=True)[:, ::-1], colours.reshape(-1, 3))
