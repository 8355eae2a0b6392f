"""Two Huber losses of one pair of images, as sums: of the frame, and of what a mask shows."""

import triton
import triton.language as tl


@triton.jit
def _huber(difference, delta):
    size = tl.abs(difference)
    return tl.where(size < delta, 0.5 * size * size, delta * (size - 0.5 * delta))


@triton.jit(do_not_specialize=["values"])
def huber(image, target, mask, delta, values, partial, BLOCK: tl.constexpr):
    """Write each program's share of both sums, partial [programs, 2]; image and target [H, W, 3], mask [H, W]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < values
    difference = tl.load(image + i, mask=here, other=0.0) - tl.load(target + i, mask=here, other=0.0)
    weight = tl.load(mask + i // 3, mask=here, other=0.0)
    tl.store(partial + 2 * tl.program_id(0), tl.sum(_huber(difference, delta), 0))
    tl.store(partial + 2 * tl.program_id(0) + 1, tl.sum(_huber(weight * difference, delta), 0))


@triton.jit(do_not_specialize=["values"])
def huber_backward(image, target, mask, delta, scales, by_frame, by_mask, values, gradient, BLOCK: tl.constexpr):
    """The image's gradient, from those of the two sums times `scales`: a number each."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < values
    difference = tl.load(image + i, mask=here, other=0.0) - tl.load(target + i, mask=here, other=0.0)
    weight = tl.load(mask + i // 3, mask=here, other=0.0)
    of_frame = (tl.load(by_frame) * tl.load(scales)).to(tl.float32)
    of_mask = (tl.load(by_mask) * tl.load(scales + 1)).to(tl.float32) * weight
    slope = of_frame * tl.minimum(tl.maximum(difference, -delta), delta)
    slope += of_mask * tl.minimum(tl.maximum(weight * difference, -delta), delta)
    tl.store(gradient + i, slope, mask=here)
