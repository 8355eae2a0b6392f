"""Procedural skin: colour, gloss, hair and relief on the UV chart, painted as functions of the place on the template.

The chart is rasterised once, which gives every texel its place on the neutral head; so patterns cross the seam.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.spatial import KDTree

from avatar.demo.blendshape_fields import smooth_step
from avatar.demo.head import DemoHead
from avatar.demo.identity import Identity
from avatar.demo.mesh import EYE_CENTRE, lip_line, smooth_max, smooth_min
from avatar.head.rasterize import rasterize_mesh

STRAND_SIZE, IRIS_SIZE = 512, 256  # texels a side


class SkinTextures(NamedTuple):
    """Float32 maps [T, T, C] whose row 0 is v = 1 (the top of the chart)."""

    colour: np.ndarray  # [T, T, 4] linear RGB and gloss
    # [T, T, 8] slopes dh/du, dh/dv in metres per chart unit: at rest, and of the three wrinkle groups
    relief: np.ndarray


def hair_cover(points: np.ndarray, identity: Identity) -> np.ndarray:
    """How far inside the hair [N] template points [N, 3] (mm) are: millimetres from the hairline, negative outside."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    front = y - (83.0 - 1e3 * identity.hairline - 0.0045 * np.clip(x - 14, 0, None) ** 2)
    # From the temple down in front of the ear to the end of the sideburn, and behind the ear to the nape.
    edge = np.interp(y, (-2.0, 22.0, 45.0, 70.0, 100.0), (6.0, 10.0, 24.0, 40.0, 66.0))
    lowest = np.where(z > -6.0, 0.5, 30.0)
    side = smooth_min(0.8 * (edge - z), y - lowest, 8.0)
    nape = -64.0 + 0.10 * (z + 90.0) + 0.004 * x**2
    behind = smooth_min(-27.0 - z, y - nape, 10.0)
    return -smooth_min(-front, -smooth_max(side, behind, 4.0), 22.0)


def fractal_noise(points: np.ndarray, period: float, octaves: int, seed: int) -> np.ndarray:
    """Smooth noise [N] of unit variance, roughly, at points [N, 3]; `period` is the size of its largest features."""
    volume = np.random.default_rng(seed).standard_normal((32, 32, 32)).astype(np.float32)
    volume = gaussian_filter(volume, 0.8, mode="wrap")
    volume /= volume.std()
    total, norm = np.zeros(len(points), np.float32), 0.0
    for octave in range(octaves):
        at = (points / period * 2.0**octave * 2.0 + 7.3 * octave).T
        total += 0.5**octave * map_coordinates(volume, at, order=1, mode="grid-wrap")
        norm += 0.25**octave
    return total / np.sqrt(norm)


def _on_chart(head: DemoHead, size: int, values: np.ndarray) -> np.ndarray:
    """Per-vertex values [V, C] on the chart [T, T, C]; uncovered texels copy the nearest."""
    mesh = head.mesh
    uv = mesh.uvs
    screen = np.stack((uv[:, 0] * size, (1.0 - uv[:, 1]) * size, np.ones(len(uv))), -1)
    raster = rasterize_mesh(screen, mesh.uv_faces, size, size)
    covered = raster.face_id >= 0
    corners = values[mesh.faces[raster.face_id]]
    out = (corners * raster.barycentric[..., None]).sum(2)
    nearest = np.asarray(distance_transform_edt(~covered, return_distances=False, return_indices=True))
    return out[nearest[0], nearest[1]].astype(np.float32)


def bake_skin(head: DemoHead, identity: Identity, size: int) -> SkinTextures:
    """Paint the person's skin on maps of `size` x `size` texels."""
    mesh = head.mesh
    V = len(head.template)
    vermilion, lash, waterline, ears = (np.zeros(V) for _ in range(4))
    for level, weight in enumerate((1.0, 1.0, 1.0, 1.0, 1.0, 0.92, 0.5)):
        vermilion[mesh.mouth_rings[:, level]] = weight
    half = mesh.eye_rings.shape[-1] // 2
    lash[mesh.eye_rings[:, 1, 1:half]] = 1.0
    lash[mesh.eye_rings[:, 2, 1:half]] = 0.62
    lash[mesh.eye_rings[:, 1, half:]] = 0.35
    waterline[mesh.eye_rings[:, 0]] = 1.0
    ears[mesh.ear_rings[:, :-2]] = 1.0
    chart = _on_chart(head, size, np.column_stack((head.template * 1e3, vermilion, lash, waterline, ears)))
    P = chart[..., :3].reshape(-1, 3)
    lip, lash_map, water, ear = (chart[..., 3 + k].reshape(-1) for k in range(4))
    lip = smooth_step(lip, 0.25, 0.75)
    x, y, z = P.T
    ax = np.abs(x)
    seed = identity.seed * 101

    def spot(cx: float, cy: float, rx: float, ry: float) -> np.ndarray:
        return np.exp(-(((ax - cx) / rx) ** 2) - ((y - cy) / ry) ** 2) * smooth_step(z, 20, 60)

    broad = fractal_noise(P, 42.0, 3, seed + 1)
    fine = fractal_noise(P, 5.0, 3, seed + 2)
    colour = np.broadcast_to(identity.skin_colour, P.shape).copy()
    colour *= 1.0 + 0.035 * broad[:, None] + 0.03 * fine[:, None]
    red = (
        0.9 * spot(40, -12, 18, 15)
        + 0.8 * spot(0, -15, 12, 10)
        + 0.35 * spot(0, -82, 16, 11)
        + 0.3 * spot(28, 24, 18, 10)
    )
    red = red + 0.10 * broad
    colour *= np.clip(1.0 - red[:, None] * np.array([-0.02, 0.20, 0.19]), 0.5, 1.3)
    yellow = spot(0, 62, 40, 18)
    colour *= 1.0 + yellow[:, None] * np.array([0.03, 0.05, 0.0])
    socket = np.exp(-(((ax - 29) / 15) ** 2) - ((y - 10.5) / 4.5) ** 2) * smooth_step(z, 40, 65)
    colour *= 1.0 - socket[:, None] * np.array([0.14, 0.18, 0.13])

    shade = smooth_step(y, -110, -66) * smooth_step(-y, 22, 44) * smooth_step(z, -2, 24)
    beard = shade * (1.0 - 0.85 * spot(0, -50, 16, 6)) * (1.0 - 0.8 * spot(46, -26, 18, 14)) * (1.0 - lip)
    beard = np.maximum(beard, spot(0, -35.5, 22, 4.5) * (1 - lip))
    dots = smooth_step(fractal_noise(P, 1.2, 1, seed + 5), -0.2, 1.6)
    cover = identity.stubble * beard * (0.24 + 0.18 * dots)
    colour = colour * (1 - cover[:, None]) + cover[:, None] * (0.5 * identity.hair_colour + 0.08 * identity.skin_colour)

    if identity.freckles > 0:
        colour *= 1.0 - _freckles(P, identity)[:, None] * np.array([0.28, 0.42, 0.50])

    lip_line_y = lip_line(np.clip(x, -25, 25))
    crease = np.exp(-(((y - lip_line_y) / 1.3) ** 2)) * lip
    folds = fractal_noise(P * np.array([1.0, 0.16, 0.3]), 2.6, 2, seed + 8)
    lips = identity.lip_colour * (1 + 0.10 * folds[:, None] + 0.05 * broad[:, None])
    lips = lips * (1 - 0.45 * crease[:, None])
    colour = colour * (1 - 0.92 * lip[:, None]) + 0.92 * lip[:, None] * lips
    nostril = np.exp(-(((ax - 6.2) / 3.0) ** 2) - ((y + 23.5) / 2.6) ** 2 - ((z - 98.5) / 6.0) ** 2)
    colour *= 1 - 0.80 * np.clip(1.25 * nostril, 0, 1)[:, None]
    colour = colour * (1 - 0.8 * water[:, None]) + 0.8 * water[:, None] * np.array([0.48, 0.22, 0.19])
    colour *= 1 - 0.93 * np.clip(lash_map, 0, 1)[:, None] ** 0.8

    brows = _brow_strokes(chart[..., :3], identity).reshape(-1)
    brow_colour = 0.55 * identity.hair_colour + 0.004
    colour = colour * (1 - brows[:, None]) + brows[:, None] * brow_colour
    inside = hair_cover(P, identity)
    strands = fractal_noise(P * np.array([1.0, 0.2, 1.0]), 3.0, 2, seed + 11)
    scalp = smooth_step(inside + 2.2 * strands, -2.0, 4.0) * (1 - ear)
    streak = np.clip(1 + 0.25 * strands, 0.4, 1.7)
    colour = colour * (1 - 0.92 * scalp[:, None]) + 0.92 * scalp[:, None] * identity.hair_colour * streak[:, None]

    gloss = (
        0.55
        + 0.5 * spot(0, 55, 34, 24)
        + 0.55 * spot(0, -6, 9, 20)
        + 0.25 * spot(0, -80, 14, 10)
        + 0.3 * spot(36, 0, 14, 10)
    )
    gloss = gloss * (1 + 0.16 * fine)
    gloss = gloss * (1 - lip) + lip * (1.25 + 0.2 * folds)
    gloss = gloss * (1 - 0.75 * beard * identity.stubble) * (1 - 0.95 * scalp) * (1 - 0.7 * brows) * (1 - 0.9 * nostril)
    gloss = gloss * (1 - water) + 2.4 * water

    pores = 0.013 * fractal_noise(P, 1.6, 2, seed + 3) * (1 - 0.7 * lip) + 0.010 * fine + 0.11 * folds * lip
    heights = np.stack((pores, *_wrinkles(P, seed)), -1).reshape(size, size, 4) * 1e-3
    slopes = []
    for k in range(4):
        du = cv2.Scharr(heights[..., k].astype(np.float32), cv2.CV_32F, 1, 0) * (size / 32.0)
        dv = -cv2.Scharr(heights[..., k].astype(np.float32), cv2.CV_32F, 0, 1) * (size / 32.0)
        slopes += [du, dv]
    rgba = np.column_stack((np.clip(colour, 0.002, 1.0), np.clip(gloss, 0.0, 3.0)))
    return SkinTextures(
        rgba.reshape(size, size, 4).astype(np.float32), np.ascontiguousarray(np.stack(slopes, -1), np.float32)
    )


def strand_tile(seed: int) -> np.ndarray:
    """A periodic map [S, S] of hair strands that run along its rows' axis; unit variance, roughly."""
    noise = np.random.default_rng((seed, 7)).standard_normal((STRAND_SIZE, STRAND_SIZE))
    fine = gaussian_filter(noise, (26.0, 0.8), mode="wrap")
    locks = gaussian_filter(noise[::-1], (40.0, 4.0), mode="wrap")
    return (0.8 * fine / fine.std() + 0.6 * locks / locks.std()).astype(np.float32)


def _freckles(P: np.ndarray, identity: Identity) -> np.ndarray:
    rng = np.random.default_rng((identity.seed, 3))
    count = int(60 + 260 * identity.freckles)
    where = np.flatnonzero((P[:, 1] > -45) & (P[:, 1] < 60) & (P[:, 2] > 45))
    weight = np.exp(-(((np.abs(P[where, 0]) - 26) / 24) ** 2) - ((P[where, 1] + 6) / 22) ** 2) + 0.06
    centres = P[rng.choice(where, count, replace=False, p=weight / weight.sum())]
    radius, strength = rng.uniform(0.5, 1.5, count), rng.uniform(0.25, 1.0, count)
    near = np.flatnonzero(P[:, 2] > 30)
    distance, index = KDTree(centres).query(P[near], distance_upper_bound=4.0)
    found = np.isfinite(distance)
    out = np.zeros(len(P))
    chosen = np.asarray(index)[found]
    out[near[found]] = strength[chosen] * (
        1 - smooth_step(distance[found], 0.5 * radius[chosen], 1.35 * radius[chosen])
    )
    return out


def _wrinkles(P: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights [N] in millimetres of forehead lines (brows up), frown lines (brows down), smile and crow's-feet lines."""
    x, y, z = P.T
    ax = np.abs(x)
    wander = fractal_noise(P, 30.0, 2, seed + 21)
    lines = np.cos((y + 1.4 * wander + 0.004 * x**2) * (2 * np.pi / 8.5)) ** 3
    forehead = 0.55 * lines * np.exp(-((x / 38) ** 4) - ((y - 64) / 15) ** 4) * smooth_step(z, 40, 70)
    between = np.exp(-(((ax - 5.0) / 1.6) ** 2) - ((y - 38) / 9) ** 2) * smooth_step(z, 60, 80)
    frown = -0.9 * between + 0.5 * np.exp(-((ax / 3.0) ** 2) - ((y - 38) / 9) ** 2)
    fold_x = 19.0 + 0.42 * np.clip(-14.0 - y, -6, 40)
    fold = -0.9 * np.exp(-(((ax - fold_x) / 2.0) ** 2)) * smooth_step(-y, 12, 22) * smooth_step(y, -58, -44)
    angle = np.arctan2(y - EYE_CENTRE[1] + 1.0, ax - 38.0)
    away = np.hypot(y - EYE_CENTRE[1], ax - 38.0)
    crow = 0.5 * np.cos(angle * 9.0 + 0.8 * wander) * np.exp(-(((away - 14) / 6.5) ** 2)) * smooth_step(ax, 42, 48)
    return forehead, frown, (fold + crow) * smooth_step(z, 15, 40)


def _brow_strokes(position: np.ndarray, identity: Identity) -> np.ndarray:
    """Cover [T, T] of the eyebrows: hairs drawn one by one along an arch over each eye."""
    size = position.shape[0]
    rng = np.random.default_rng((identity.seed, 4))
    flat = position.reshape(-1, 3)
    near = np.flatnonzero((flat[:, 2] > 45) & (flat[:, 1] > 22) & (flat[:, 1] < 62))
    tree = KDTree(flat[near, :2])
    mask = np.zeros((size, size), np.uint8)
    soft = np.zeros((size, size), np.float32)
    count = int(90 + 170 * identity.brow_density)
    for side in (1.0, -1.0):
        s = rng.random(count)
        arch_x = 11.5 + 35.5 * s
        arch_y = 38.6 + 6.0 * np.sin(np.clip(s / 0.68, 0, 1.45) * np.pi / 2) - 1.5 * s
        thick = 3.3 * (1 - 0.75 * s**1.6) * (0.75 + 0.4 * identity.brow_density)
        root = np.stack((arch_x, arch_y + thick * rng.uniform(-1, 1, count)), -1)
        lean = np.radians(np.interp(s, (0, 0.12, 0.35, 1.0), (60, 42, 18, -20))) + 0.22 * rng.standard_normal(count)
        length = rng.uniform(3.0, 5.2, count) * (0.7 + 0.3 * np.minimum(4 * s, 1)) * (1 - 0.3 * s)
        tip = root + length[:, None] * np.stack((np.cos(lean), np.sin(lean)), -1)
        ends = np.stack((root, tip), 1) * np.array([side, 1.0])
        _, nearest = tree.query(ends.reshape(-1, 2))
        texel = np.stack((near[nearest] % size, near[nearest] // size), -1).reshape(-1, 2, 2)
        for a, b in texel:
            cv2.line(mask, tuple(map(int, a * 8)), tuple(map(int, b * 8)), 200, 1, cv2.LINE_AA, 3)
            cv2.line(soft, tuple(map(int, a)), tuple(map(int, b)), 1.0, max(size // 256, 1))
    soft = cv2.GaussianBlur(soft, (0, 0), size / 300)
    return np.clip(mask / 255.0 * 0.85 + 0.42 * soft, 0, 0.95) * (0.6 + 0.4 * identity.brow_density)


def paint_iris(identity: Identity) -> np.ndarray:
    """The eyeball's colour [S, S, 3] over (x, y) of its surface direction in [-1, 1]; the pupil is in the middle."""
    rng = np.random.default_rng((identity.seed, 6))
    axis = (np.arange(IRIS_SIZE) + 0.5) / IRIS_SIZE * 2 - 1
    x, y = np.meshgrid(axis, -axis)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    iris = 0.455
    r = radius / iris
    phases, waves = rng.uniform(0, 2 * np.pi, 24), rng.integers(8, 70, 24)
    rays = [np.cos(w * angle + p + 1.7 * np.sin(6 * r + p)) for w, p in zip(waves, phases, strict=True)]
    fibres = np.sum(rays, axis=0) / 5.0
    ring = np.exp(-(((r - 0.46) / 0.10) ** 2))
    colour = identity.iris_colour * (1.0 + 0.38 * fibres[..., None] + 0.54 * smooth_step(r, 0.35, 0.8)[..., None])
    colour = colour + ring[..., None] * identity.iris_colour * np.array([1.3, 0.8, 0.4])
    colour *= (1 - 0.88 * smooth_step(r, 0.76, 1.0))[..., None]
    pupil = 1 - smooth_step(r, 0.36, 0.41)
    colour = colour * (1 - pupil[..., None]) + pupil[..., None] * 0.002
    white = np.array([0.68, 0.64, 0.61]) * (1 - 0.14 * smooth_step(radius, 0.6, 1.0))[..., None]
    veins = np.clip(np.cos(angle * 2) ** 2 * smooth_step(radius, 0.62, 1.0), 0, 1)
    white = white * (1 - veins[..., None] * np.array([0.02, 0.20, 0.20]))
    edge = smooth_step(r, 0.93, 1.07)[..., None]
    return np.clip(colour * (1 - edge) + white * edge, 0, 1).astype(np.float32)
