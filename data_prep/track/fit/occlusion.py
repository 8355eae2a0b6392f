"""Frames in which something is before the face, such as a hand: skin there shows other grey values than in most frames."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree
from torch import Tensor

from data_prep.track.fit.texture import lit_texture

# On four real clips hands before the face are 0.05 to 0.24 of it, half of them over 0.1; without hands it is 0.05 at most,
# or 0.09 where the head tilts as in no other frame.
COVERED_SHARE = 0.06
_NEIGHBOURS = 16  # points whose mean is judged: wrinkles and noise are smaller
_LEAST, _USUAL = 0.08, 3.0  # grey values from 0 to 1, and standard deviations of the points in the frames that fit
_DOUBTED = 0.05  # weight of the half of the frames that fits worse: their light is found, the texture is of the others
_ROUNDS = 3


def covered_shares(
    values: Float[Tensor, "T N"],
    weights: Float[Tensor, "T N"],
    basis: Float[Tensor, "N B"],
    places: Float[Tensor, "N 3"],
) -> Float[Tensor, " T"]:
    """The share of the face that is seen in each frame and does not look like it; 0 where nothing is seen.

    `values` are grey, `weights` from 0 (not seen) to 1, `basis` that of `lit_texture`, `places` of the resting head.
    """
    k = min(_NEIGHBOURS, len(places))
    _, nearest = KDTree(places.numpy()).query(places.numpy(), k=k)
    rows = np.arange(len(places)).repeat(k)
    around = csr_matrix((np.full(len(rows), 1 / k), (rows, np.ravel(nearest))))

    def mean_around(numbers: Float[Tensor, "T N"]) -> Float[Tensor, "T N"]:
        return torch.from_numpy((around @ numbers.T.numpy()).T)

    seen = mean_around(weights)
    is_seen = seen > 1 / 3
    shares, trust = values.new_zeros(len(values)), values.new_ones(len(values), 1)
    for _ in range(_ROUNDS):
        trusted = trust * weights
        residuals = values - lit_texture(values, trusted, basis).values(basis)
        squares = (trusted * residuals.square().clamp(max=0.1**2)).sum(0) / trusted.sum(0).clamp(min=1e-9)
        allowed = (_USUAL * mean_around(squares.sqrt()[None])).clamp(min=_LEAST)
        off = mean_around(weights * residuals) / seen.clamp(min=1e-9)
        shares = ((off.abs() > allowed) & is_seen).sum(1) / is_seen.sum(1).clamp(min=1)
        trust = torch.where(shares <= shares.median(), 1.0, _DOUBTED).to(values)[:, None]
    return shares
