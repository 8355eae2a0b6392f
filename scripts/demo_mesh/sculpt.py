"""The neutral head as an implicit surface: smooth unions of ellipsoids and round cones, after anthropometric averages.

Millimetres, FLAME's axes: x to the subject's left, y up, z forward out of the face. Symmetric in x. The inside is
negative. The values are approximate distances (ellipsoids are scaled spheres), good enough to find the surface on a ray.
Smooth minimum and primitives: Quilez, "distance functions", https://iquilezles.org/articles/distfunctions.
"""

from __future__ import annotations

import numpy as np

from avatar.demo.mesh import EYE_CENTRE, EYE_RADIUS, smooth_max, smooth_min

LID_RADIUS = EYE_RADIUS + 1.1
RAY_ORIGIN = np.array([0.0, 0.0, -5.0])  # every part of the skin but the ears is seen from here


def _ellipsoid(p: np.ndarray, centre: tuple[float, float, float], radii: tuple[float, float, float]) -> np.ndarray:
    q = (p - np.array(centre)) / np.array(radii)
    k0 = np.sqrt((q * q).sum(-1))
    q /= np.array(radii)
    return k0 * (k0 - 1.0) / np.maximum(np.sqrt((q * q).sum(-1)), 1e-9)


def _round_cone(
    p: np.ndarray, a: tuple[float, float, float], b: tuple[float, float, float], ra: float, rb: float
) -> np.ndarray:
    start, axis = np.array(a), np.array(b) - np.array(a)
    h = np.clip(((p - start) @ axis) / (axis @ axis), 0.0, 1.0)
    offset = p - start - h[..., None] * axis
    return np.sqrt((offset * offset).sum(-1)) - (ra + (rb - ra) * h)


def head_distance(points: np.ndarray) -> np.ndarray:
    """Approximate signed distance [N] in millimetres of points [N, 3] to the neutral head without ears and lips."""
    p = np.array(points, dtype=np.float64)
    p[..., 0] = np.abs(p[..., 0])
    skull = _ellipsoid(p, (0, 52, -16), (75, 82, 96))
    skull = smooth_min(skull, _ellipsoid(p, (0, 56, 26), (60, 56, 66)), 18)
    temple = _ellipsoid(p, (92, 34, 58), (24, 36, 36))
    skull = smooth_max(skull, -temple, 30)

    face = _ellipsoid(p, (0, 0, 30), (60, 76, 56))
    face = smooth_min(face, _ellipsoid(p, (0, -46, 38), (44, 44, 46)), 26)
    face = smooth_min(face, _round_cone(p, (44, -40, 0), (15, -77, 64), 12, 12), 26)
    face = smooth_min(face, _ellipsoid(p, (0, -80, 73), (17, 14, 16)), 18)
    face = smooth_min(face, _ellipsoid(p, (0, -43, 63), (30, 27, 29)), 18)
    face = smooth_min(face, _round_cone(p, (36, -4, 64), (52, 0, 30), 15, 12), 24)
    face = smooth_min(face, _ellipsoid(p, (27, -17, 68), (19, 19, 17)), 18)
    head = smooth_min(skull, face, 22)

    brow = _round_cone(p, (10, 37, 81.5), (40, 39, 65), 9.0, 8.0)
    head = smooth_min(head, brow, 14)
    socket = _ellipsoid(p, (31, 22.5, 90), (19.5, 12.5, 14))
    head = smooth_max(head, -socket, 12)
    lids = np.sqrt(((p - EYE_CENTRE) ** 2).sum(-1)) - LID_RADIUS
    head = smooth_min(head, lids, 6)

    nose = _round_cone(p, (0, 27, 81), (0, -6, 98), 7.2, 8.6)
    nose = smooth_min(nose, _ellipsoid(p, (0, -13.5, 103), (10.0, 9.0, 10.0)), 10)
    nose = smooth_min(nose, _ellipsoid(p, (11.0, -17.5, 93), (7.0, 7.5, 11.0)), 9)
    nose = smooth_min(nose, _round_cone(p, (0, -20, 102), (0, -27, 88), 3.5, 4.0), 7)
    head = smooth_min(head, nose, 13)
    nostril = _ellipsoid(p, (5.6, -25.5, 98.0), (2.4, 3.4, 4.2))
    head = smooth_max(head, -nostril, 3.5)
    philtrum = _round_cone(p, (0, -29, 96.0), (0, -38, 97.0), 2.2, 2.8)
    head = smooth_max(head, -philtrum, 5)
    chin_crease = _ellipsoid(p, (0, -64.5, 97), (19, 4.5, 6))
    head = smooth_max(head, -chin_crease, 10)

    neck = _neck_distance(p)
    return smooth_min(head, neck, 14)


def _neck_distance(p: np.ndarray) -> np.ndarray:
    """An elliptic column that leans back to the nape and widens towards the shoulders."""
    down = np.clip((-60.0 - p[..., 1]) / 110.0, 0.0, 1.3)
    centre_z = -26.0 - 8.0 * down
    half_x = 48.0 + 6.0 * down**2
    half_z = 46.0 + 4.0 * down**2
    q = np.stack((p[..., 0] / half_x, (p[..., 2] - centre_z) / half_z), -1)
    column = (np.sqrt((q * q).sum(-1)) - 1.0) * np.minimum(half_x, half_z)
    column = smooth_max(column, p[..., 1] - 10.0, 20)
    larynx = _ellipsoid(p, (0, -118, 6), (9, 15, 14))
    tendon = _round_cone(p, (40, -70, -18), (14, -175, 6), 9, 9)
    return smooth_min(smooth_min(column, larynx, 16), tendon, 14)


def cast(origins: np.ndarray, directions: np.ndarray, far: float = 240.0, near: float = 0.0) -> np.ndarray:
    """The outermost surface point [N, 3] on each ray `origin + s * direction`, near <= s <= far (unit directions).

    Raises ValueError where a ray meets no surface.
    """
    origins = np.broadcast_to(np.asarray(origins, np.float64), directions.shape)
    steps = np.arange(far, near, -4.0)
    outside = np.full(len(directions), far)
    found = np.zeros(len(directions), bool)
    for s in steps:
        todo = np.flatnonzero(~found)
        if not len(todo):
            break
        inside = head_distance(origins[todo] + s * directions[todo]) < 0.0
        found[todo[inside]] = True
        outside[todo[~inside]] = s
    if not found.all():
        raise ValueError(f"{int((~found).sum())} of {len(found)} rays miss the head surface")
    low, high = outside - 4.0, outside.copy()
    for _ in range(18):
        middle = 0.5 * (low + high)
        inside = head_distance(origins + middle[:, None] * directions) < 0.0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return origins + (0.5 * (low + high))[:, None] * directions


def cast_front(xy: np.ndarray) -> np.ndarray:
    """Surface points [N, 3] seen from the front at frontal coordinates [N, 2]."""
    origins = np.concatenate((xy, np.zeros((len(xy), 1))), -1)
    return cast(origins, np.broadcast_to(np.array([0.0, 0.0, 1.0]), origins.shape), far=140.0)


def cast_side(zy: np.ndarray) -> np.ndarray:
    """Surface points [N, 3] seen from the subject's left at (z, y) [N, 2]."""
    origins = np.stack((np.zeros(len(zy)), zy[:, 1], zy[:, 0]), -1)
    return cast(origins, np.broadcast_to(np.array([1.0, 0.0, 0.0]), origins.shape), far=120.0)
