"""Loose hair: strands thinner than a pixel that stand off the hair's surface, where a matte is neither 0 nor 1."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar.demo import shading
from avatar.demo.lighting import Lights, unit
from avatar.demo.scene import HAIR, Performer, face_normals

_LOCKS, _STRANDS, _POINTS = 1800, 8000, 9
_THINNEST_HAIR = 2.5  # millimetres above the scalp, below which none is loose
_LENGTH, _LONGEST = 11.0, 42.0  # millimetres: the usual one, and the most
_WIDTH = 0.14  # millimetres at the root: some hairs that lie together
_GRAVITY, _INWARDS = 0.012, 0.02  # how strands bend down and back to the head, 1 / millimetres


class Drawn(NamedTuple):
    """What the strands add to a picture; float32."""

    clear: np.ndarray  # [H, W] share of each pixel that shows what is behind them
    row: np.ndarray  # [N] of the pixels with strands
    column: np.ndarray
    colour: np.ndarray  # [N, 3] linear, of their strands


class LooseHair:
    """The strands of one person: each keeps its root on the hair's surface and its shape in the head's space."""

    def __init__(self, performer: Performer) -> None:
        rng = np.random.default_rng((performer.identity.seed, 13))
        faces = performer.hair_faces
        faces = faces[(performer.hair_height[faces] > 1e-3 * _THINNEST_HAIR).all(1)]
        areas = face_normals(performer.hair_rest, faces)
        size = np.linalg.norm(areas, axis=1)
        of_lock = rng.choice(len(faces), _LOCKS, p=size / size.sum())
        lock = rng.integers(0, _LOCKS, _STRANDS)

        def drawn(of_locks: float, own: float) -> np.ndarray:
            """[N, 3] standard deviations of what a lock's strands share, and of what each has of its own."""
            return of_locks * rng.standard_normal((_LOCKS, 3))[lock] + own * rng.standard_normal((_STRANDS, 3))

        self._corners = faces[of_lock[lock]] + performer.starts[HAIR]
        self._weights = rng.dirichlet((1.0, 1.0, 1.0), _STRANDS).astype(np.float32)
        self.pattern = rng.standard_normal(_STRANDS).astype(np.float32)
        normals = unit(areas[of_lock[lock]])
        combed = performer.strands[faces[of_lock[lock]]].mean(1)
        combed = unit(combed - (combed * normals).sum(1, keepdims=True) * normals)
        length = np.minimum(_LENGTH * np.exp(0.5 * drawn(1.0, 0.4)[:, 0]), _LONGEST)
        step = (length / (_POINTS - 1))[:, None]
        ahead = unit(combed + np.abs(0.28 + drawn(0.2, 0.15)[:, :1]) * normals + drawn(0.25, 0.15))
        bend = drawn(0.035, 0.02) - np.array([0.0, _GRAVITY, 0.0]) - _INWARDS * normals  # per millimetre
        at = [np.zeros_like(ahead)]
        for _ in range(_POINTS - 1):
            at.append(at[-1] + step * ahead)
            ahead = unit(ahead + step * bend)
        self._offsets = (1e-3 * np.stack(at, 1)).astype(np.float32)
        taper = 1.0 - 0.8 * np.linspace(0.0, 1.0, _POINTS) ** 2
        self.widths = (1e-3 * _WIDTH * np.exp(0.4 * drawn(0.0, 1.0)[:, :1]) * taper).astype(np.float32)  # [N, K] metres

    def on_root(self, values: np.ndarray) -> np.ndarray:
        """Per-vertex values [V, C] of the scene at every strand's root [N, C]."""
        return np.einsum("nkc,nk->nc", values[self._corners], self._weights)

    def points(self, posed: np.ndarray) -> np.ndarray:
        """The strands [N, K, 3] on the scene's posed points [V, 3], in the head's space."""
        return self.on_root(posed)[:, None] + self._offsets


def shade(
    hair: LooseHair, points: np.ndarray, surface: np.ndarray, view: np.ndarray, lit: np.ndarray, lights: Lights
) -> np.ndarray:
    """Linear colours [N, K, 3] of strands at `points` [N, K, 3] in the studio's axes; `surface` [V, 7] is the scene's."""
    count = points.shape[1]
    along = unit(np.gradient(points, axis=1).reshape(-1, 3))
    rooted = np.repeat(hair.on_root(surface), count, axis=0)
    outwards = unit(rooted[:, :3] - (rooted[:, :3] * along).sum(1, keepdims=True) * along)
    whole = shading.Surface(outwards, view, rooted[:, 3], rooted[:, 4:], lit)
    return shading.hair(whole, lights, along, np.repeat(hair.pattern, count)).reshape(points.shape)


def draw(screen: np.ndarray, widths: np.ndarray, colours: np.ndarray, depth: np.ndarray) -> Drawn:
    """Strands [N, K, 3] at (x, y, depth) of pixels, `widths` [N, K] pixels wide, where nothing is nearer.

    `depth` [H, W] is that of what else there is, 0 where there is nothing.
    """
    values = np.concatenate((screen, widths[..., None], colours), -1)
    start, end = values[:, :-1].reshape(-1, 7), values[:, 1:].reshape(-1, 7)
    length = np.linalg.norm(end[:, :2] - start[:, :2], axis=1)
    count = np.maximum(np.ceil(length), 1).astype(np.int64)
    piece = np.repeat(np.arange(len(count)), count)
    along = (np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[piece]
    sample = start[piece] + along[:, None].astype(np.float32) * (end - start)[piece]
    area = sample[:, 3] * (length / count)[piece]
    height, width = depth.shape
    corner = np.floor(sample[:, :2] - 0.5).astype(np.int64)
    part = sample[:, :2] - 0.5 - corner
    pixels, covers, seen = [], [], []
    for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = corner[:, 0] + x, corner[:, 1] + y
        on = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
        behind = depth[row[on], column[on]]
        cover = np.minimum(area[on] * np.abs(1 - x - part[on, 0]) * np.abs(1 - y - part[on, 1]), 0.95)
        some = (cover > 0) & ((behind == 0) | (sample[on, 2] < behind))
        on = on[some]
        pixels.append(row[on] * width + column[on])
        covers.append(cover[some])
        seen.append(on)
    pixel, cover, of = map(np.concatenate, (pixels, covers, seen))
    at, place = np.unique(pixel, return_inverse=True)
    weight = np.bincount(place, cover)
    colour = np.stack([np.bincount(place, cover * sample[of, 4 + c]) for c in range(3)], -1) / weight[:, None]
    clear = np.exp(np.bincount(pixel, np.log1p(-cover), height * width)).reshape(height, width)
    return Drawn(clear.astype(np.float32), at // width, at % width, colour.astype(np.float32))
