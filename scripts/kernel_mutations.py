"""Deliberate mistakes in the splatter's kernels, each of which the tests have to catch; see `mutate_kernels.py`."""

from __future__ import annotations

from typing import NamedTuple


class Mutation(NamedTuple):
    module: str  # of avatar.kernels
    what: str  # it does wrong
    old: str  # occurs once in the module
    new: str
    first: str = ""  # part of the name of the test that sees it soonest


SPLATTER_MUTATIONS = [
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
        "p_z >= tl.load(intrinsics + NEAR)",
        "p_z >= 0.5 * tl.load(intrinsics + NEAR)",
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
        "+ dot3(tl.load(pose + 1), tl.load(pose + 4), tl.load(pose + 7), t0, t1, t2)",
        "- t1",
    ),
    Mutation(
        "geometry",
        "all but the last value of a pose may be infinite",
        "found |= (bits",
        "found = (bits",
        first="of_a_pose",
    ),
    Mutation(
        "project",
        "a pose that is not finite shows the background",
        "poisoned = pose_is_not_finite(pose)",
        "poisoned = False",
        first="of_a_pose",
    ),
    Mutation(
        "sh",
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
        "& (done + k < pairs)[:, None]\n    alpha",
        "\n    alpha",
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
        "sh",
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
        "project_backward",
        "the camera's rotation does not turn covariances",
        "by_p * mean_x + t * by_x + e0",
        "by_p * mean_x + t * by_x",
        first="reference[17x33",
    ),
    Mutation(
        "project_backward",
        "the optical axis turns covariances along rows only",
        "-slope_x * e01 - slope_y * e11",
        "-slope_x * e01",
        first="reference[17x33",
    ),
    Mutation(
        "project_backward",
        "the camera's rotation does not move its eye",
        "by_p * mean_y + t * by_y + e1",
        "by_p * mean_y + e1",
        first="reference[17x33",
    ),
    Mutation(
        "project_backward",
        "the camera's translation does not move its eye",
        "by_p + dot3(v0, v1, v2, by_x, by_y, by_z)",
        "by_p",
        first="reference[17x33",
    ),
    Mutation(
        "project_backward",
        "all programs write the same share of the pose's gradient",
        "grad_pose + POSE_VALUES * tl.program_id(0)",
        "grad_pose",
        first="production",
    ),
    Mutation(
        "sh",
        "a basis function's derivative is halved",
        "dz += 2 * z * g",
        "dz += z * g",
        first="reference[17x33",
    ),
]
