"""One parameter's Adam step."""

import triton
import triton.language as tl


@triton.jit(do_not_specialize=["values"])
def adam(
    parameter,
    gradient,
    mean,
    square,
    rate,
    share,
    steps,
    stop,
    values,
    BETA1: tl.constexpr,
    BETA2: tl.constexpr,
    EPSILON: tl.constexpr,
    LOG2_BETA1: tl.constexpr,
    LOG2_BETA2: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Update a parameter and its running means of the gradient and of its square, float32, unless `stop` is not zero.

    The learning rate is `share` times `rate`. share, steps and stop are float32 of one value; `steps` counts this one.
    """
    first, i = tl.program_id(0).to(tl.int64) * BLOCK, tl.arange(0, BLOCK)  # of 2^31 values and more
    here = i < tl.where(tl.load(stop) == 0.0, values - first, 0)
    parameter, gradient, mean, square = parameter + first, gradient + first, mean + first, square + first
    t = tl.load(steps).to(tl.float64)
    step_size = rate * tl.load(share) / (1.0 - tl.exp2(t * LOG2_BETA1)).to(tl.float32)
    spread = (1.0 - tl.exp2(t * LOG2_BETA2)).to(tl.float32)
    g = tl.load(gradient + i, mask=here, other=0.0)
    m = BETA1 * tl.load(mean + i, mask=here, other=0.0) + (1.0 - BETA1) * g
    v = BETA2 * tl.load(square + i, mask=here, other=0.0) + (1.0 - BETA2) * g * g
    p = tl.load(parameter + i, mask=here, other=0.0)
    tl.store(mean + i, m, mask=here)
    tl.store(square + i, v, mask=here)
    tl.store(parameter + i, p - step_size * m / (tl.sqrt(v) / tl.sqrt(spread) + EPSILON), mask=here)
