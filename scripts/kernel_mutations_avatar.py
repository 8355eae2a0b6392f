"""Deliberate mistakes in the kernels before and after the splatter's; see `mutate_kernels.py`."""

from __future__ import annotations

from kernel_mutations import Mutation

AVATAR_MUTATIONS = [
    # From the network's values to Gaussians.
    Mutation("hyper", "a latent is mixed from three nodes of four", "tl.static_range(4)", "tl.static_range(3)"),
    Mutation(
        "hyper",
        "a triangular factor is solved without an element",
        "row(values, FACTOR + 7, mask) * x3\n",
        "0.0 * x3\n",
    ),
    Mutation(
        "fused_gaussians",
        "the offset turns before the base",
        "product(bw, bx, by, bz, tl.exp(r0), r1, r2, r3)",
        "product(tl.exp(r0), r1, r2, r3, bw, bx, by, bz)",
    ),
    Mutation(
        "fused_gaussians_backward",
        "a factor's diagonal is taken as it is stored",
        "-s1 * q1 * tl.exp(row(values, FACTOR + 2, mask))",
        "-s1 * q1",
    ),
    Mutation(
        "fused_gaussians_backward",
        "lanes without a Gaussian are not written",
        "_put(grads, at + 12, q9 * from_mean, all_lanes)",
        "_put(grads, at + 12, q9 * from_mean, mask)",
        first="lanes_that_stand",
    ),
    Mutation(
        "fused_gaussians_backward", "a node's list ends an entry early", "begins + node + 1)", "begins + node + 1) - 1"
    ),
    Mutation("activations", "tanh is wrong where it saturates", "tl.where(x < 0.0, -far, far)", "far"),
    # Posing and losses.
    Mutation(
        "pose",
        "the right eyelid moves with the left",
        "right * tl.load(eyelid_directions",
        "left * tl.load(eyelid_directions",
    ),
    Mutation("pose", "the jaw does not follow the expression's shift of the neck", "x + t0 - u", "x - u"),
    Mutation(
        "pose",
        "coefficients that are not given hold what was there",
        "mask=e < given, other=0.0",
        "mask=e < stride, other=0.0",
        first="bands[posed]",
    ),
    Mutation(
        "ssim",
        "the gradient is smoothed along columns the other way",
        "at = tl.load(window + k), i - k * line",
        "at = tl.load(window + k), i + k * line",
    ),
    Mutation("ssim", "the contrast's gradient has the wrong sign", "-light / contrast", "light / contrast"),
    Mutation(
        "huber", "the difference is not clamped", "tl.minimum(tl.maximum(difference, -delta), delta)", "difference"
    ),
    Mutation(
        "huber",
        "the mask weighs the loss and not the difference",
        "tl.sum(_huber(weight * difference, delta), 0)",
        "tl.sum(weight * _huber(difference, delta), 0)",
    ),
    Mutation(
        "reduce", "the last programs' shares are left out", "range(0, programs, BLOCK)", "range(0, programs - 1, BLOCK)"
    ),
    # Adam.
    Mutation("adam", "the mean square is not corrected", "tl.sqrt(v) / tl.sqrt(spread)", "tl.sqrt(v)"),
    Mutation("adam", "a step that is to do nothing moves", "tl.load(stop) == 0.0", "tl.load(stop) >= 0.0"),
    Mutation("adam", "the share of the rate is left out", "rate * tl.load(share)", "rate"),
]
