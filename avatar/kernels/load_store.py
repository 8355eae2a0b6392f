"""Reading and writing of a few values a lane, row by row in memory."""

import triton
import triton.language as tl


@triton.jit
def load3(rows, index, mask):
    x = tl.load(rows + 3 * index, mask=mask, other=0.0)
    y = tl.load(rows + 3 * index + 1, mask=mask, other=0.0)
    z = tl.load(rows + 3 * index + 2, mask=mask, other=0.0)
    return x, y, z


@triton.jit
def load4(rows, index, mask):
    w = tl.load(rows + 4 * index, mask=mask, other=0.0)
    x = tl.load(rows + 4 * index + 1, mask=mask, other=0.0)
    y = tl.load(rows + 4 * index + 2, mask=mask, other=0.0)
    z = tl.load(rows + 4 * index + 3, mask=mask, other=0.0)
    return w, x, y, z


@triton.jit
def store3(rows, index, x, y, z, mask):
    tl.store(rows + 3 * index, x, mask=mask)
    tl.store(rows + 3 * index + 1, y, mask=mask)
    tl.store(rows + 3 * index + 2, z, mask=mask)


@triton.jit
def store4(rows, index, w, x, y, z, mask):
    tl.store(rows + 4 * index, w, mask=mask)
    tl.store(rows + 4 * index + 1, x, mask=mask)
    tl.store(rows + 4 * index + 2, y, mask=mask)
    tl.store(rows + 4 * index + 3, z, mask=mask)


@triton.jit
def load10(rows, index, mask):
    """The raw offsets of a Gaussian: position, rotation, scale."""
    at = rows + 10 * index
    p0, p1, p2 = (
        tl.load(at, mask=mask, other=0.0),
        tl.load(at + 1, mask=mask, other=0.0),
        tl.load(at + 2, mask=mask, other=0.0),
    )
    r0, r1 = tl.load(at + 3, mask=mask, other=0.0), tl.load(at + 4, mask=mask, other=0.0)
    r2, r3 = tl.load(at + 5, mask=mask, other=0.0), tl.load(at + 6, mask=mask, other=0.0)
    s0, s1, s2 = (
        tl.load(at + 7, mask=mask, other=0.0),
        tl.load(at + 8, mask=mask, other=0.0),
        tl.load(at + 9, mask=mask, other=0.0),
    )
    return p0, p1, p2, r0, r1, r2, r3, s0, s1, s2


@triton.jit
def store10(rows, index, p0, p1, p2, r0, r1, r2, r3, s0, s1, s2, mask):
    at = rows + 10 * index
    tl.store(at, p0, mask=mask)
    tl.store(at + 1, p1, mask=mask)
    tl.store(at + 2, p2, mask=mask)
    tl.store(at + 3, r0, mask=mask)
    tl.store(at + 4, r1, mask=mask)
    tl.store(at + 5, r2, mask=mask)
    tl.store(at + 6, r3, mask=mask)
    tl.store(at + 7, s0, mask=mask)
    tl.store(at + 8, s1, mask=mask)
    tl.store(at + 9, s2, mask=mask)
