"""The HyperGaussians of one Gaussian a lane, in the packed order of `avatar.gaussians.hyper.pack`."""

import triton
import triton.language as tl

PACKED = tl.constexpr(16)  # Gaussians side by side in a row
# Rows of a block: ten means; the lower triangles of the position's, the rotation's and the scale's factor, row by row; then
# for each latent dimension and head the latent's mean and the head's values of the cross term.
POSITION_FACTOR, ROTATION_FACTOR, SCALE_FACTOR = tl.constexpr(10), tl.constexpr(16), tl.constexpr(26)
CONSTANTS, DIMENSION = tl.constexpr(32), tl.constexpr(13)


@triton.jit
def first_row(packed, i, latents):
    """Where Gaussian i's values begin; they are PACKED apart. All Gaussians may have more of them than 32 bits count."""
    return packed + (i // PACKED).to(tl.int64) * ((CONSTANTS + DIMENSION * latents) * PACKED) + i % PACKED


@triton.jit
def row(values, k, mask):
    return tl.load(values + PACKED * k, mask=mask, other=0.0)


@triton.jit
def diagonal(values, k, mask):
    return tl.exp(row(values, k, mask))


@triton.jit
def mixed(nodes, cells, weights, i, latents, d, HAS_GRID: tl.constexpr, mask):
    """Value d of Gaussian i's latent: its own, or mixed from those of four nodes."""
    if HAS_GRID:
        value = tl.zeros_like(i).to(tl.float32)
        for corner in tl.static_range(4):
            cell = tl.load(cells + 4 * i + corner, mask=mask, other=0)
            weight = tl.load(weights + 4 * i + corner, mask=mask, other=0.0)
            value += weight * tl.load(nodes + cell * latents + d, mask=mask, other=0.0)
        return value
    return tl.load(nodes + i * latents + d, mask=mask, other=0.0)


@triton.jit
def solve3_upper(values, FACTOR: tl.constexpr, p0, p1, p2, mask):
    """x with L^T x = p."""
    x2 = p2 / diagonal(values, FACTOR + 5, mask)
    x1 = (p1 - row(values, FACTOR + 4, mask) * x2) / diagonal(values, FACTOR + 2, mask)
    x0 = p0 - row(values, FACTOR + 1, mask) * x1 - row(values, FACTOR + 3, mask) * x2
    return x0 / diagonal(values, FACTOR, mask), x1, x2


@triton.jit
def solve4_upper(values, FACTOR: tl.constexpr, p0, p1, p2, p3, mask):
    x3 = p3 / diagonal(values, FACTOR + 9, mask)
    x2 = (p2 - row(values, FACTOR + 8, mask) * x3) / diagonal(values, FACTOR + 5, mask)
    x1 = p1 - row(values, FACTOR + 4, mask) * x2 - row(values, FACTOR + 7, mask) * x3
    x1 = x1 / diagonal(values, FACTOR + 2, mask)
    x0 = p0 - row(values, FACTOR + 1, mask) * x1 - row(values, FACTOR + 3, mask) * x2
    x0 = x0 - row(values, FACTOR + 6, mask) * x3
    return x0 / diagonal(values, FACTOR, mask), x1, x2, x3


@triton.jit
def solve3_lower(values, FACTOR: tl.constexpr, p0, p1, p2, mask):
    """x with L x = p."""
    x0 = p0 / diagonal(values, FACTOR, mask)
    x1 = (p1 - row(values, FACTOR + 1, mask) * x0) / diagonal(values, FACTOR + 2, mask)
    x2 = p2 - row(values, FACTOR + 3, mask) * x0 - row(values, FACTOR + 4, mask) * x1
    return x0, x1, x2 / diagonal(values, FACTOR + 5, mask)


@triton.jit
def solve4_lower(values, FACTOR: tl.constexpr, p0, p1, p2, p3, mask):
    x0 = p0 / diagonal(values, FACTOR, mask)
    x1 = (p1 - row(values, FACTOR + 1, mask) * x0) / diagonal(values, FACTOR + 2, mask)
    x2 = p2 - row(values, FACTOR + 3, mask) * x0 - row(values, FACTOR + 4, mask) * x1
    x2 = x2 / diagonal(values, FACTOR + 5, mask)
    x3 = p3 - row(values, FACTOR + 6, mask) * x0 - row(values, FACTOR + 7, mask) * x1
    x3 = x3 - row(values, FACTOR + 8, mask) * x2
    return x0, x1, x2, x3 / diagonal(values, FACTOR + 9, mask)
