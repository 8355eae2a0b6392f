"""A tracking made worse in the way that trackers err.

Measured on real people, photometric refinement moved heads by 0.4 degrees and 1.1 mm and coefficients by 10 % of what they
vary; a fifth of that came and went from frame to frame, the rest drifted.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from avatar.data.recording import Recording
from avatar.head.model import HeadModel
from avatar.pose_refinement.tracking_values import PARTS, SHIFT, TURN, moved_tracks, values_of

TURN_DEGREES, SHIFT_MM, COEFFICIENT_SHARE = 0.4, 1.1, 0.1  # root mean squares: of vectors, and of each coefficient
JITTER_SHARE = 0.2  # of the error, white from frame to frame
DRIFT_SECONDS = 0.8  # over which the rest changes


def perturbed(recording: Recording, head: HeadModel, seed: int) -> Recording:
    """The recording with errors such as those of real trackers; the same for the same seed. The neck keeps still."""
    given = values_of(recording.tracks)
    size = torch.zeros(given.shape[1], dtype=torch.float64)
    for part in ("jaw", "eyes", "eyelids", "expression"):
        size[PARTS[part]] = COEFFICIENT_SHARE * given[:, PARTS[part]].double().std(dim=0, unbiased=False)
    size[TURN] = math.radians(TURN_DEGREES) / math.sqrt(3.0)
    size[SHIFT] = 1e-3 * SHIFT_MM / math.sqrt(3.0)
    errors = size * tracking_noise(np.random.default_rng(seed), len(given), given.shape[1], recording.fps)
    centre = head.neutral_vertices().mean(dim=0)
    tracks = moved_tracks(recording.tracks, given + errors.to(given), size > 0, centre)
    return replace(recording, tracks=tracks)


def tracking_noise(rng: np.random.Generator, frames: int, values: int, fps: float) -> Float[Tensor, "frames values"]:
    """Unit variance: smooth over DRIFT_SECONDS, and white for JITTER_SHARE of it; float64."""
    sigma = 0.5 * DRIFT_SECONDS * fps
    pad = int(4 * sigma) + 1
    drift = gaussian_filter1d(rng.standard_normal((frames + 2 * pad, values)), sigma, axis=0)[pad : pad + frames]
    drift *= math.sqrt(2.0 * math.sqrt(math.pi) * sigma)  # what the filter has taken from the variance
    white = rng.standard_normal((frames, values))
    return torch.from_numpy(math.sqrt(1.0 - JITTER_SHARE**2) * drift + JITTER_SHARE * white)
