"""Sums in a fixed order: what many programs found, by one."""

import triton
import triton.language as tl


@triton.jit(do_not_specialize=["programs"])
def finish(partial, scales, programs, out, COLUMNS: tl.constexpr, BLOCK: tl.constexpr):
    """One program: out[c] = scales[c] * sum over rows of partial [programs, COLUMNS]; added up in float64."""
    row, column = tl.arange(0, BLOCK), tl.arange(0, COLUMNS)
    total = tl.zeros([BLOCK, COLUMNS], tl.float64)
    for first in range(0, programs, BLOCK):
        at = (first + row)[:, None] * COLUMNS + column[None, :]
        total += tl.load(partial + at, mask=(first + row < programs)[:, None], other=0.0).to(tl.float64)
    tl.store(out + column, (tl.sum(total, 0) * tl.load(scales + column)).to(tl.float32))
