"""Light, fixed in the studio: soft key, fill and rim lights, a hemisphere of ambient light, windows that mirrors see.

Directions are in the studio's axes: x right, y up, z towards the front camera. Everything is linear
and unclamped until `tone_map`.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

SKY = np.array([0.50, 0.55, 0.62], np.float32)
GROUND = np.array([0.30, 0.23, 0.19], np.float32)
KEY_COLOUR = np.array([2.30, 2.16, 1.96], np.float32)
FILL_COLOUR = np.array([0.46, 0.52, 0.62], np.float32)
RIM_COLOUR = np.array([0.75, 0.80, 0.90], np.float32)
EXPOSURE = 0.52
SHADOW_SIZE = 288
SHADOW_REACH = 0.36  # metres of scene that the shadow map covers
SHADOW_SHARPNESS = 230.0  # 1 / metres, of the exponential shadow map
SHADOW_BIAS = 0.0035  # metres


class Lights(NamedTuple):
    """Unit directions towards the lights, float32 [3]."""

    key: np.ndarray
    fill: np.ndarray
    rim: np.ndarray


def make_lights(key_side: float) -> Lights:
    """`key_side` from -1 (key light from the front image's left) to 1 (from its right)."""
    directions = [(0.72 * key_side, 0.55, 0.72), (-0.9 * key_side, 0.12, 0.6), (-0.75 * key_side, 0.45, -0.62)]
    return Lights(*[(np.array(d) / np.linalg.norm(d)).astype(np.float32) for d in directions])


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [N, 3] made unit length."""
    return vectors / np.sqrt(np.maximum(np.einsum("nc,nc->n", vectors, vectors), 1e-20))[:, None]


def turn(vectors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Float32 vectors [N, 3] times `matrix` [K, 3] -> [N, K].

    By OpenCV on one thread: frames are rendered side by side, and a BLAS that wakes its own threads for such thin
    products takes a fifth more processor time.
    """
    if not len(vectors):
        return np.zeros((0, len(matrix)), np.float32)
    product = cv2.transform(np.asarray(vectors, np.float32)[:, None], np.asarray(matrix, np.float32))
    return product.reshape(len(vectors), len(matrix))


def along(vectors: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The components [N] of vectors [N, 3] along a unit direction [3]."""
    return turn(vectors, direction[None])[:, 0]


def lookup(texture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear samples [N, C] of a float32 map [T, T, C <= 4] at texel coordinates [N, 2] (0 is the first centre)."""
    columns = -(-len(at) // 512)
    padded = np.zeros((512 * columns, 2), np.float32)
    padded[: len(at)] = at
    grid = padded.reshape(512, columns, 2)
    out = cv2.remap(texture, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out.reshape(512 * columns, -1)[: len(at)]


def ambient(normals: np.ndarray) -> np.ndarray:
    """Irradiance [N, 3] / pi from sky and ground."""
    up = 0.5 + 0.5 * normals[:, 1:2]
    return GROUND + up * (SKY - GROUND)


def wrapped(normals: np.ndarray, light: np.ndarray, wrap: np.ndarray) -> np.ndarray:
    """Diffuse reflection [N, 3] with light wrapped around the terminator by `wrap` [3] (more in red: skin scatters it).

    Source: "Real-Time Approximations to Subsurface Scattering", GPU Gems (2004), chapter 16.
    """
    return np.maximum(along(normals, light)[:, None] + wrap, 0.0) / (1.0 + wrap) ** 2


def gloss(normals: np.ndarray, view: np.ndarray, light: np.ndarray, roughness: float, f0: float) -> np.ndarray:
    """Cook-Torrance reflection [N] (GGX, Schlick's Fresnel, Kelemen's visibility) times n.l, for unit light intensity."""
    half = unit(view + light)
    n_l = np.maximum(along(normals, light), 0.0)
    n_h = np.einsum("nc,nc->n", normals, half)
    v_h = np.maximum(np.einsum("nc,nc->n", view, half), 0.05)
    a2 = roughness**4
    d = a2 / (np.pi * np.square(n_h * n_h * (a2 - 1.0) + 1.0))
    fresnel = f0 + (1.0 - f0) * (1.0 - np.minimum(v_h, 1.0)) ** 5
    return d * fresnel / (4.0 * v_h * v_h) * n_l


def _panel(directions: np.ndarray, centre: np.ndarray, half_width: float, half_height: float, bars: bool) -> np.ndarray:
    """How much [N] of a rectangular window is seen in each direction."""
    right = np.cross(np.array([0.0, 1.0, 0.0]), centre)
    right = (right / np.linalg.norm(right)).astype(np.float32)
    up = np.cross(centre, right).astype(np.float32)
    place = turn(directions, np.stack((right, up, centre)))
    ahead = np.maximum(place[:, 2], 1e-3)
    x, y = np.abs(place[:, 0] / ahead), np.abs(place[:, 1] / ahead)
    seen = np.clip((half_width - x) / 0.06 + 0.5, 0, 1) * np.clip((half_height - y) / 0.06 + 0.5, 0, 1)
    if bars:
        seen = seen * np.clip((np.minimum(x, y) - 0.03) / 0.03, 0, 1)
    return seen * (ahead > 2e-3)


def mirror_world(directions: np.ndarray, lights: Lights) -> np.ndarray:
    """Radiance [N, 3] that a mirror sees in unit directions [N, 3]: two windows, sky, ground, and a dim room."""
    up = directions[:, 1:2]
    room = 0.10 + 0.22 * np.clip(up, 0, 1) * SKY + 0.05 * np.clip(-up, 0, 1) * GROUND
    room = room + _panel(directions, lights.key, 0.34, 0.42, True)[:, None] * (5.2 * KEY_COLOUR)
    return room + _panel(directions, lights.fill, 0.22, 0.6, False)[:, None] * (3.2 * FILL_COLOUR)


def blurred_shadow_map(depth: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Exponential shadow map of occluder depths [S, S] in metres about 0, blurred to soften the edge.

    Source: Annen, Mertens, Seidel, Flerackers, Kautz, "Exponential Shadow Maps" (2008).
    """
    d = np.where(covered, depth, SHADOW_REACH / 2).astype(np.float32)
    return cv2.GaussianBlur(np.exp(SHADOW_SHARPNESS * d), (0, 0), 2.6)


def shadow_basis(light: np.ndarray) -> np.ndarray:
    """Rows [3, 3]: the shadow map's right, down and depth (away from the light) axes in the studio."""
    right = np.cross(np.array([0.0, 1.0, 0.0]), light)
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(right, light), -light)).astype(np.float32)


def lit_share(shadow_map: np.ndarray, points_on_map: np.ndarray) -> np.ndarray:
    """Share of the key light [N] that reaches points [N, 3] given in shadow-map pixels and depth in metres."""
    seen = lookup(shadow_map, points_on_map[:, :2] - 0.5)[:, 0]
    return np.minimum(seen * np.exp(-SHADOW_SHARPNESS * (points_on_map[:, 2] - SHADOW_BIAS)), 1.0)


def _tone_table() -> np.ndarray:
    x = (np.arange(4097) / 512.0) ** 2 * EXPOSURE
    curve = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    curve = np.clip(curve, 0.0, 1.0)
    srgb = np.where(curve <= 0.0031308, 12.92 * curve, 1.055 * np.maximum(curve, 1e-9) ** (1 / 2.4) - 0.055)
    return (255.0 * srgb).astype(np.float32)


_TONE = _tone_table()


def tone_map(linear: np.ndarray) -> np.ndarray:
    """Linear light -> sRGB values in [0, 255], float32, by a filmic curve (Narkowicz's fit to ACES)."""
    index = np.sqrt(np.clip(linear, 0.0, 63.9)) * 512.0
    return _TONE[np.minimum(index, 4096.0).astype(np.int32)]
