"""Noise on what the network is told of a training frame.

Expressions of a tracker err, and a network that takes them at their word learns the errors by heart: of expressions that it
has not seen it then makes too much. The mesh, which is posed already, stays where it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import to_device
from avatar.config import TrainerConfig
from avatar.data.recording import Recording
from avatar.types import Frame

_STREAM = 1  # of random numbers, beside that of the frames' order


class ConditionNoise:
    """Normal, with `share` of the standard deviations of the training frames' conditions and with their correlations."""

    def __init__(self, conditions: Float[Tensor, "T C"], share: float, seed: int) -> None:
        centred = conditions - conditions.mean(dim=0)
        self._deviations = share / len(conditions) ** 0.5 * centred
        self._seed = seed

    def on(self, step: int, frame: Frame) -> Frame:
        """The frame as step `step` (from 0) tells the network of it: a function of seed and step."""
        return noisy(frame, to_device(self.of(step), frame.params.expression.device))

    def of(self, step: int) -> Float[Tensor, " C"]:
        """What is added in step `step`; on the CPU."""
        generator = np.random.default_rng([self._seed, step, _STREAM])
        # A sum of deviations with weights that are independent and normal has their covariance.
        weights = generator.standard_normal(len(self._deviations), dtype=np.float32)
        return torch.from_numpy(weights) @ self._deviations


def noisy(frame: Frame, noise: Float[Tensor, " C"]) -> Frame:
    return replace(frame, params=frame.params.with_condition(frame.params.condition() + noise))


def make_noise(recording: Recording, config: TrainerConfig) -> ConditionNoise | None:
    """For a training on the recording's training frames; None without noise."""
    if config.condition_noise == 0:
        return None
    conditions = torch.stack([params.condition() for params in recording.motion(recording.split.train)])
    return ConditionNoise(conditions, config.condition_noise, config.seed)
