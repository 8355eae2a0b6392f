"""Deliberate mistakes in the compositing of features; see `mutate_kernels.py`."""

from __future__ import annotations

from kernel_mutations import Mutation

FEATURE_MUTATIONS = [
    Mutation(
        "project",
        "a feature that is not finite goes unseen",
        "for k in range(channels):",
        "for k in range(channels - 1):",
        first="a_feature_that",
    ),
    Mutation(
        "composite_features",
        "features are read one channel off",
        "splat[:, None] * channels + channel[None, :]",
        "splat[:, None] * channels + (channel[None, :] + 1) % channels",
    ),
    Mutation(
        "composite_features",
        "the last channel of an image is left out",
        "mask = (channel < channels)[:, None] & inside",
        "mask = (channel < channels - 1)[:, None] & inside",
    ),
    Mutation(
        "composite_features",
        "all groups of channels are the first",
        "channel = tl.program_id(0) % groups * GROUP + tl.arange(0, GROUP)\n    column",
        "channel = tl.arange(0, GROUP)\n    column",
        first="33-gpu",
    ),
    Mutation(
        "composite_features",
        "a channel shows its neighbour's background",
        "tl.load(background + channel, mask=channel < channels",
        "tl.load(background + channel + 1, mask=channel + 1 < channels",
    ),
    Mutation(
        "composite_features",
        "what lies behind has the first group's background",
        "tl.load(background + group + c, mask",
        "tl.load(background + c, mask",
        first="33-gpu",
    ),
    Mutation(
        "composite_features",
        "too little room is silent",
        'tl.where(spoilt, float("nan"), transmittance)',
        "transmittance",
        first="a_feature_that",
    ),
    Mutation(
        "composite_features",
        "alpha's gradient misses all groups but the last",
        "g = tl.dot(own, by_pixel, g, ",
        "g = tl.dot(own, by_pixel, tl.zeros_like(g), ",
        first="33-gpu",
    ),
    Mutation(
        "composite_features",
        "the second group's features have no gradient",
        "tl.store(to, by_own, mask",
        "tl.store(to, tl.where(group > 0, 0.0, by_own), mask",
        first="33-gpu",
    ),
    Mutation(
        "composite_features",
        "a feature's gradient misses the splat's first slot",
        "range(0, tl.max(tiles, 0), LANES)",
        "range(1, tl.max(tiles, 0), LANES)",
    ),
    Mutation(
        "composite_features",
        "gradients of features that nobody looked at are not cleared",
        "tl.store(to, tl.zeros([STEP, GROUP], tl.float32), mask=mask)",
        "tl.store(to, tl.zeros([STEP, GROUP], tl.float32), mask=mask & (group > 0))",
        first="bands[features]",
    ),
    Mutation(
        "composite_features",
        "what lies behind is forgotten between chunks",
        "behind += tl.sum(adds, 0)",
        "behind += 0.0",
        first="other cut-offs",
    ),
    Mutation(
        "composite_features",
        "alpha's cotangent has the wrong sign",
        "behind -= tl.load",
        "behind += tl.load",
    ),
    Mutation(
        "composite_features",
        "a clamped alpha has a gradient",
        "tl.where(drawn & (unclamped <= alpha_max), ",
        "tl.where(shown > 0.0, ",
        first="other cut-offs",
    ),
]
