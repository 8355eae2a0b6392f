"""Motion over time: what pictures leave open is filled in by the frames before and after.

After each frame has its own best moves m_t, the joint minimum of

    1/2 sum_t (x_t - m_t)^T A (x_t - m_t)  +  1/2 sum_t w . (x_{t-1} - 2 x_t + x_{t+1} + a_t)^2

is found in one go: A is the curvature that all frames share (with the prior's), a_t the acceleration of the given motion,
w how calm each value is. A move is changed little where the picture determined it and freely where it did not, such as
along the line of sight. With A = W^1/2 Q diag(l) Q^T W^1/2, W = diag(w), the values fall apart into F problems of their
own, each a band of five diagonals over time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import solveh_banded
from scipy.sparse import csr_array
from torch import Tensor


def smoothed(
    moves: Float[Tensor, "T F"],
    curvature: Float[Tensor, "F F"],
    acceleration: Float[Tensor, "T F"],
    calm: Float[Tensor, " F"],
    numbers: Sequence[int] | np.ndarray,
) -> Float[Tensor, "T F"]:
    """The joint minimum, computed in float64; `curvature` positive definite, `calm` positive.

    numbers   of the frames in the video: frames that are not neighbours there are not tied to each other
    """
    differences = second_differences(numbers)
    if not len(_middles(numbers)):
        return moves
    root = calm.double().sqrt()
    strengths, basis = torch.linalg.eigh(curvature.double() / root[:, None] / root)
    own = ((moves.double() * root) @ basis).numpy()
    given = ((acceleration * root) @ basis).numpy()[_middles(numbers)]
    pull = differences.T @ given
    ties = (differences.T @ differences).tocsr()
    band = np.stack([np.pad(ties.diagonal(k), (0, k)) for k in range(3)])
    solved = np.empty_like(own)
    for k, strength in enumerate(strengths.tolist()):
        diagonals = band.copy()
        diagonals[0] += strength
        solved[:, k] = solveh_banded(diagonals, strength * own[:, k] - pull[:, k], lower=True)
    return ((torch.from_numpy(solved) @ basis.T) / root).to(moves.dtype)


def second_differences(numbers: Sequence[int] | np.ndarray) -> csr_array:
    """A row (1, -2, 1) for every three frames that follow each other, [rows, T]."""
    middles = _middles(numbers)
    rows = np.repeat(np.arange(len(middles)), 3)
    columns = (middles[:, None] + (-1, 0, 1)).ravel()
    weights = np.tile((1.0, -2.0, 1.0), len(middles))
    return csr_array((weights, (rows, columns)), shape=(len(middles), len(numbers)))


def _middles(numbers: Sequence[int] | np.ndarray) -> np.ndarray:
    """Positions of the frames that have both their neighbours."""
    steps = np.diff(np.asarray(numbers, np.int64))
    return np.flatnonzero((steps[:-1] == 1) & (steps[1:] == 1)) + 1
