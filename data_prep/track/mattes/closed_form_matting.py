"""Closed-form matting of a narrow band: how much of each of its pixels is foreground (Levin, Lischinski, Weiss 2008).

In every 3x3 window the foreground's share is taken for a linear function of the colour. Of all functions that are known
outside the band, the one is sought that comes nearest to that everywhere: a sparse linear system with one unknown for each
pixel of the band.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import cg

LARGEST = 1024  # pixels of the longer side of pictures that are matted: it bounds memory and time
_MOST_UNKNOWN = 40_000  # pixels; a head's band has a fifth at most, and more is no band
_NETWORK_SIDE = 320  # pixels of a picture that are one of the network's, its error included
_PRECISION = 1e-6  # of the solution: 255 levels are kept, and a factorisation takes up to twenty times as long
_OFFSETS = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]


def band_radius(height: int, width: int) -> int:
    """Pixels on both sides of an edge found at the network's size, within which the true one lies."""
    return max(1, round(max(height, width) / _NETWORK_SIDE))


def within_limits(
    refine: Callable[..., UInt8[np.ndarray, "h w"]], image: UInt8[np.ndarray, "H W 3"], *masks: UInt8[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W"]:
    """`refine(image, *masks)`, of smaller pictures where these are larger than `LARGEST`."""
    height, width = image.shape[:2]
    if max(height, width) <= LARGEST:
        return refine(image, *masks)
    return cv2.resize(refine(*map(limited, (image, *masks))), (width, height), interpolation=cv2.INTER_LINEAR)


def limited(pixels: UInt8[np.ndarray, "H W *C"]) -> UInt8[np.ndarray, "h w *C"]:
    """A picture or mask at the size at which it is matted: a copy, smaller where it is larger than `LARGEST`."""
    height, width = pixels.shape[:2]
    scale = LARGEST / max(height, width)
    if scale >= 1.0:
        return pixels.copy()
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def closed_form(
    image: UInt8[np.ndarray, "H W 3"],
    guess: Float32[np.ndarray, "H W"],
    band: Bool[np.ndarray, "H W"],
    noise: float = 3e-3,
    trust: float = 1e-3,
) -> Float32[np.ndarray, "H W"]:
    """`guess` with what the colours say in `band`, in [0, 1]; outside it is kept, and all where the band is too large.

    `noise` is the standard deviation of the picture's noise, levels / 255, which windows of one colour need. `trust` draws
    the solution towards the guess, where colours say nothing.
    """
    result = np.ascontiguousarray(guess, np.float32).copy()
    band = band.copy()
    band[[0, -1]] = band[:, [0, -1]] = False  # windows end at the picture's border
    if not 0 < np.count_nonzero(band) <= _MOST_UNKNOWN:
        return result
    height, width = band.shape
    centres = np.flatnonzero(_inner(cv2.dilate(band.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0))
    pixels = centres[:, None] + np.array([y * width + x for y, x in _OFFSETS])  # [K, 9]
    colours = image.reshape(-1, 3)[pixels].astype(np.float32) / 255.0
    colours -= colours.mean(1, keepdims=True)
    covariance = np.einsum("kic,kid->kcd", colours, colours) / 9.0 + noise**2 * np.eye(3, dtype=np.float32)
    spread = colours @ np.linalg.inv(covariance)
    weights = (1.0 + spread @ colours.transpose(0, 2, 1)) / 9.0  # affinities [K, 9, 9]
    unknown = np.flatnonzero(band)
    number = np.full(height * width, -1, np.int32)
    number[unknown] = np.arange(len(unknown))
    ours = number[pixels]
    rows, columns = np.broadcast_arrays(ours[:, :, None], ours[:, None, :])
    both = (rows >= 0) & (columns >= 0)
    n = len(unknown)
    affinity = csr_matrix((weights[both].astype(np.float64), (rows[both], columns[both])), (n, n))
    windows = np.bincount(ours[ours >= 0], minlength=n)  # that hold each pixel
    known = np.where(band, np.float32(0.0), result).reshape(-1)[pixels]
    given = (weights @ known[:, :, None])[..., 0]
    right = np.bincount(ours[ours >= 0], given[ours >= 0].astype(np.float64), minlength=n)
    system = diags(windows + trust) - affinity
    start = result.reshape(-1)[unknown].astype(np.float64)
    solution, _ = cg(system.tocsr(), right + trust * start, x0=start, rtol=_PRECISION)
    result.reshape(-1)[unknown] = np.clip(solution, 0.0, 1.0)
    return result


def _inner(mask: np.ndarray) -> np.ndarray:
    mask[[0, -1]] = mask[:, [0, -1]] = False
    return mask
