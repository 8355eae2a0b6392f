"""One identity for a clip: trackers that fit every frame by itself leave another one in each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from avatar.head.assets import HeadAssets

SAME = 1e-5  # metres: rounding
MAX_CHANGE = 2e-3  # metres: what a tracked head may be off without being another's (see `check_alignment`)
_USUAL = 90  # percentile of the frames that has to be below


class Identities(NamedTuple):
    """Of T frames, against their median."""

    median: Float[np.ndarray, " S"]  # the first one, where all are the same
    change: Float[np.ndarray, " T"]  # metres, root mean square over the vertices

    @property
    def are_same(self) -> bool:
        return bool(self.change.max() <= SAME)

    @property
    def are_many(self) -> bool:
        """Whether they change so much that no one of them is the clip's."""
        return bool(np.percentile(self.change, _USUAL) > MAX_CHANGE)

    def sentence(self) -> str:
        usual, most = 1e3 * float(np.median(self.change)), 1e3 * float(self.change.max())
        return f"the identity changes from frame to frame, by {usual:.2g} mm in the median and {most:.2g} mm at most"


def compare_identities(shapes: Float[np.ndarray, "T S"], head: HeadAssets) -> Identities:
    """How far the head at rest changes with the identity coefficients of each frame."""
    if (shapes == shapes[0]).all():
        return Identities(shapes[0], np.zeros(len(shapes)))
    directions = head.shape_dirs.double().numpy().reshape(-1, shapes.shape[1])
    median = np.median(shapes, axis=0)
    away = shapes - median
    squares = np.einsum("ts,sr,tr->t", away, directions.T @ directions, away)
    found = Identities(median, np.sqrt(np.maximum(squares, 0) / head.num_vertices))
    return found._replace(median=shapes[0]) if found.are_same else found
