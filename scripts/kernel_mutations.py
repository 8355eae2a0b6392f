"""Deliberate mistakes in the GPU's kernels, each of which the tests have to catch; see `mutate_kernels.py`."""

from __future__ import annotations

from typing import NamedTuple


class Mutation(NamedTuple):
    module: str  # of avatar.kernels
    what: str  # it does wrong
    old: str  # occurs once in the module
    new: str
    first: str = ""  # part of the name of the test that sees it soonest


MUTATIONS = [
    # Which splats a tile is given.
    Mutation(
        "project",
        "a splat whose opacity is the cut-off is left out",
        "opacity < alpha_min\n",
        "opacity <= alpha_min\n",
        first="just_under_the_cut_off",
    ),
    Mutation(
        "project",
        "a splat just behind the near plane is drawn",
        "p_z >= tl.load(view + NEAR)",
        "p_z >= 0.5 * tl.load(view + NEAR)",
        first="other cut-offs",
    ),
    Mutation(
        "project",
        "pixel centres lie at whole numbers",
        "tl.ceil(low - 0.5)",
        "tl.ceil(low + 0.5)",
        first="loops[opaque",
    ),
    Mutation(
        "project",
        "the ellipse's box is as high as it is wide",
        "tl.sqrt(tl.where(drawn, yy, 0.0))",
        "tl.sqrt(tl.where(drawn, xx, 0.0))",
        first="clamp-gpu",
    ),
    Mutation(
        "project",
        "a splat without the blur keeps its opacity",
        "opacity * area / root_det",
        "opacity",
        first="loops[antialiased",
    ),
    Mutation("project", "a colour may be negative", "tl.maximum(green, 0.0)", "green"),
    Mutation(
        "project",
        "a scale that is not finite goes unseen",
        "load(scales + 3 * i + k",
        "load(scales + 3 * i",
        first="nobody_waits",
    ),
    Mutation("geometry", "the slope is not clamped", "return clamped, (slope", "return slope, (slope"),
    Mutation(
        "geometry",
        "the camera looks from its translation",
        "tl.load(view + CENTRE + 1)",
        "tl.load(view + TRANSLATION + 1)",
    ),
    Mutation(
        "harmonics",
        "a function of degree 3 has the wrong sign",
        "-x * (4 * z * z - x * x - y * y) * C31 * on, sh, 13",
        "x * (4 * z * z - x * x - y * y) * C31 * on, sh, 13",
    ),
    Mutation("bin", "a slot without a record claims one", "tl.where(live, place, -1)", "place", first="wide field"),
    Mutation(
        "bin",
        "the search for a slot's splat ends a step too early",
        "for _ in range(steps):",
        "for _ in range(steps - 1):",
    ),
    Mutation("bin", "tiles near to a splat are left out", "slack_u, slack_v = 1e-6", "slack_u, slack_v = -0.1"),
    Mutation(
        "bin",
        "the colours of a chunk's end are not cleared",
        "tl.static_range(6, FIELDS)",
        "tl.static_range(7, FIELDS)",
        first="reference[17x33",
    ),
    Mutation(
        "bin",
        "the lists of two tiles overlap",
        "// CHUNK + tile) * CHUNK",
        "// CHUNK + tile // 2) * CHUNK",
        first="reference[17x33",
    ),
    # Forward.
    Mutation(
        "composite",
        "the neighbour's list is read too",
        "& (done + k < pairs)[:, None]\n        alpha",
        "\n        alpha",
    ),
    Mutation(
        "composite",
        "alpha is not clamped",
        "alpha = tl.minimum(unclamped, alpha_max)",
        "alpha = unclamped",
        first="loops[cut-offs",
    ),
    Mutation(
        "composite",
        "a splat whose alpha is the cut-off is skipped",
        "hit = (alpha >= alpha_min)",
        "hit = (alpha > alpha_min)",
        first="just_under_the_cut_off",
    ),
    Mutation(
        "composite",
        "the splat that closes a pixel is drawn",
        "enough = (after >= t_min)",
        "enough = (after / (1.0 - alpha) >= t_min)",
        first="other cut-offs",
    ),
    Mutation(
        "composite", "a pixel's stop is one splat late", "reached, stop)", "reached + 1, stop)", first="other cut-offs"
    ),
    Mutation(
        "composite", "the transmittance is that behind the splat", "after * (alpha / (1.0 - alpha))", "after * alpha"
    ),
    Mutation(
        "composite", "green shows blue's background", "tl.load(background + 1), mask", "tl.load(background + 2), mask"
    ),
    Mutation(
        "composite",
        "too little room is silent",
        'tl.where(spoilt, float("nan"), transmittance)',
        "transmittance",
        first="exactly_the_pairs",
    ),
    # Backward.
    Mutation(
        "composite_backward",
        "a splat hides itself",
        "k[None, :] > k[:, None]",
        "k[None, :] >= k[:, None]",
        first="reference[17x33",
    ),
    Mutation(
        "composite_backward",
        "alpha's cotangent has the wrong sign",
        "behind -= tl.load",
        "behind += tl.load",
        first="reference[17x33",
    ),
    Mutation(
        "composite_backward",
        "a clamped alpha has a gradient",
        "drawn & (unclamped <= alpha_max)",
        "drawn",
        first="other cut-offs",
    ),
    Mutation(
        "composite_backward",
        "moments that nobody looked at are not cleared",
        "range(seen, pairs, STEP)",
        "range(pairs, pairs, STEP)",
        first="bands[walls]",
    ),
    Mutation(
        "composite_backward",
        "a mixed moment is not mixed",
        "tl.sum(weight_u * v, 1)",
        "tl.sum(weight_u * u, 1)",
        first="reference[17x33",
    ),
    Mutation(
        "composite_backward",
        "what lies behind is forgotten between chunks",
        "behind += tl.sum(adds, 0)",
        "behind += 0.0",
        first="wide field",
    ),
    Mutation(
        "project_backward",
        "a splat's first slot is left out",
        "range(0, tl.max(tiles, 0), LANES)",
        "range(1, tl.max(tiles, 0), LANES)",
        first="reference[17x33",
    ),
    Mutation(
        "harmonics",
        "a colour below 0 has a gradient",
        "tl.where(value > 0.0, upstream, 0.0)",
        "upstream",
        first="reference[17x33",
    ),
    Mutation(
        "project_backward",
        "a clamped slope has a gradient",
        "tl.where(free_x, -fx * inv_z * along_z, 0.0)",
        "-fx * inv_z * along_z",
        first="reference[17x33",
    ),
    Mutation(
        "project_backward",
        "the direction's length has a gradient",
        "(by_dx - along * d_x)",
        "by_dx",
        first="reference[17x33",
    ),
    Mutation(
        "harmonics",
        "a basis function's derivative is halved",
        "dz += 2 * z * g",
        "dz += z * g",
        first="reference[17x33",
    ),
    # From the network's values to Gaussians.
    Mutation("hyper", "a latent is mixed from three nodes of four", "tl.static_range(4)", "tl.static_range(3)"),
    Mutation(
        "hyper",
        "a triangular factor is solved without an element",
        "row(values, FACTOR + 7, mask) * x3\n",
        "0.0 * x3\n",
    ),
    Mutation(
        "place",
        "the offset turns before the base",
        "product(bw, bx, by, bz, tl.exp(r0), r1, r2, r3)",
        "product(tl.exp(r0), r1, r2, r3, bw, bx, by, bz)",
    ),
    Mutation(
        "place_backward",
        "a factor's diagonal is taken as it is stored",
        "-s1 * q1 * tl.exp(row(values, FACTOR + 2, mask))",
        "-s1 * q1",
    ),
    Mutation(
        "place_backward",
        "lanes without a Gaussian are not written",
        "_put(grads, at + 12, q9 * from_mean, all_lanes)",
        "_put(grads, at + 12, q9 * from_mean, mask)",
        first="lanes_that_stand",
    ),
    Mutation("place_backward", "a node's list ends an entry early", "begins + node + 1)", "begins + node + 1) - 1"),
    Mutation("activations", "tanh is wrong where it saturates", "tl.where(x < 0.0, -far, far)", "far"),
    # Posing and losses.
    Mutation(
        "pose",
        "the right eyelid moves with the left",
        "right * tl.load(eyelid_directions",
        "left * tl.load(eyelid_directions",
    ),
    Mutation("pose", "the neck does not carry the jaw", "a + t0 - u", "a - u"),
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
]
