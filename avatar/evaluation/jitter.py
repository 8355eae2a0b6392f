"""Temporal jitter: what flickers in a video and no figure of single frames shows."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.compute.device import to_device
from avatar.evaluation.measure import Pair
from avatar.losses.metrics import weighted_mean


class _TimeStep(NamedTuple):
    time: int
    error: Float[Tensor, "H W 3"]  # render - truth, levels of 8 bits
    mask: UInt8[Tensor, "H W"]


class JitterMeter:
    """The jitter of frame t: with e = render - truth in levels of 8 bits, the mean over pixels and channels of
    |e(t-1) - 2 e(t) + e(t+1)|, the pixels weighted by the smallest of the three frames' head masks.

    An error that stays, or drifts at a constant rate, adds nothing; one that comes and goes counts up to four times its
    size. Noise of the camera is part of e, so figures compare over the same frames only.
    """

    def __init__(self) -> None:
        self.of: dict[tuple[int, int], float] = {}  # camera, time of the middle frame; NaN: no pixel in all three masks
        self._recent: dict[int, deque[_TimeStep]] = {}

    def add(self, camera: int, time: int, pair: Pair, head_mask: UInt8[Tensor, "H W"]) -> None:
        """A camera's next picture in the order of time; three of successive `time` give the middle one its figure."""
        error = pair.render.float() - pair.truth.float()
        error = error if pair.render.dtype == torch.uint8 else error * 255.0
        recent = self._recent.setdefault(camera, deque(maxlen=3))
        recent.append(_TimeStep(time, error, to_device(head_mask, error.device)))
        if len(recent) < 3:
            return
        before, middle, after = recent
        if (before.time, after.time) == (middle.time - 1, middle.time + 1):
            change = (before.error - 2.0 * middle.error + after.error).abs().mean(dim=-1, dtype=torch.float64)
            weight = torch.minimum(torch.minimum(before.mask, middle.mask), after.mask)
            self.of[camera, middle.time] = weighted_mean(change, weight).item()
