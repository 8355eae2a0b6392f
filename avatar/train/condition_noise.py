"""Noise on the network's input in training.

Tracked expressions err, and without noise the network overfits their errors. The posed mesh gets no noise.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.config import TrainerConfig
from avatar.data.recording import Recording

_STREAM = 1  # of random numbers, beside that of the frames' order


class ConditionNoise:
    """Normal, with `share` of the standard deviations of the training frames' conditions and with their correlations."""

    def __init__(self, conditions: Float[Tensor, "T C"], share: float, seed: int) -> None:
        centred = conditions - conditions.mean(dim=0)
        self._deviations = share / len(conditions) ** 0.5 * centred
        self._seed = seed

    def of(self, step: int) -> Float[Tensor, " C"]:
        """What is added in step `step` (from 0): a function of seed and step; on the CPU."""
        return torch.from_numpy(self._weights(step)) @ self._deviations

    def of_steps(self, steps: range) -> Float[Tensor, "S C"]:
        """What is added in each of these steps, to rounding."""
        return torch.from_numpy(np.stack([self._weights(step) for step in steps])) @ self._deviations

    def _weights(self, step: int) -> Float[np.ndarray, " T"]:
        """Of the deviations: a sum of them with weights that are independent and normal has their covariance."""
        generator = np.random.default_rng([self._seed, step, _STREAM])
        return generator.standard_normal(len(self._deviations), dtype=np.float32)


def make_noise(recording: Recording, config: TrainerConfig) -> ConditionNoise | None:
    """For a training on the recording's training frames; None without noise."""
    if config.condition_noise == 0:
        return None
    conditions = torch.stack([params.condition() for params in recording.motion(recording.split.train)])
    return ConditionNoise(conditions, config.condition_noise, config.seed)
