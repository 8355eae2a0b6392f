"""Which colours are a person's clothes and which are skin, learned once for a clip.

A single frame cannot tell a collar on the mesh's neck from hair, and divides it now so and now so. Over the clip, clothes
are known beside the neck, and skin on the face and in the middle of the neck: a mixture of normal distributions of each, in
CIE L*a*b*, says of every other pixel which it is more like.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_prep.track.neck_zones import Zones

CLIP_FRAMES = 24  # that are learned from, spread over the clip
# Heights above the neck ring, and the distance from the head's axis; 1 is the middle of the head.
_FACE = (0.30, 1.00)
_NECK, _NECK_ASIDE = (0.15, 0.30), 0.12
_CLOTHES = 0.25  # below, beside the mesh
_EDGE = 5  # pixels of the matte's edge, whose colours are mixed
_FEWEST, _MOST = 500, 6000  # pixels that a mixture is made of
_COMPONENTS, _ROUNDS = 4, 30
_NOISE = 4.0  # variance that every component has besides, of L*, a* and b*
_LIKELIER = 1.0  # logarithm of how many times likelier clothes must be


class Mixture(NamedTuple):
    """Of normal distributions; densities are all times the same constant."""

    means: Float[np.ndarray, "K 3"]
    precisions: Float[np.ndarray, "K 3 3"]
    weights: Float[np.ndarray, " K"]  # logarithms, of the normalisation too

    def log_density(self, colours: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        away = colours[:, None] - self.means
        squares = np.einsum("nki,kij,nkj->nk", away, self.precisions, away)
        return np.logaddexp.reduce(self.weights - 0.5 * squares, axis=1)


class Colours(NamedTuple):
    skin: tuple[Mixture, ...]  # of the face, of the neck
    clothes: Mixture

    def are_clothes(self, image: UInt8[np.ndarray, "H W 3"], where: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """The pixels of `where` that are more like clothes."""
        found = np.zeros_like(where)
        colours = _lab(image)[where]
        skin = np.max([mixture.log_density(colours) for mixture in self.skin], axis=0)
        found[where] = self.clothes.log_density(colours) - skin > _LIKELIER
        return found


def learn_colours(clip: Iterable[Zones]) -> Colours | None:
    """The colours of some frames of a clip; None where these show too little of skin or clothes."""
    face, neck, clothes = [], [], []
    for zones in clip:
        person = cv2.erode(zones.person.astype(np.uint8), np.ones((_EDGE, _EDGE), np.uint8)) > 0
        colours, level = _lab(zones.image), zones.level
        on_mesh, beside = person & zones.inside, person & zones.outside
        face.append(colours[on_mesh & (level > _FACE[0]) & (level < _FACE[1])])
        neck.append(colours[on_mesh & (level > _NECK[0]) & (level < _NECK[1]) & (zones.aside < _NECK_ASIDE)])
        clothes.append(colours[beside & (level < _CLOTHES)])
    mixtures = [_mixture(np.concatenate(parts)) for parts in (face, neck, clothes) if parts]
    if len(mixtures) < 3 or mixtures[0] is None or mixtures[2] is None:
        return None
    return Colours(tuple(mixture for mixture in mixtures[:2] if mixture is not None), mixtures[2])


def _mixture(colours: Float[np.ndarray, "N 3"]) -> Mixture | None:
    """By expectation maximisation; None for too few colours."""
    if len(colours) < _FEWEST:
        return None
    cv2.setRNGSeed(0)  # it starts from random means
    model = cv2.ml.EM.create()
    model.setClustersNumber(_COMPONENTS)
    model.setCovarianceMatrixType(cv2.ml.EM_COV_MAT_GENERIC)
    model.setTermCriteria((cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ROUNDS, 1e-3))
    model.trainEM(np.ascontiguousarray(colours[:: -(-len(colours) // _MOST)], np.float32))
    covariances = np.stack(model.getCovs()) + _NOISE * np.eye(3)
    weights = np.log(np.maximum(model.getWeights()[0], 1e-9)) - 0.5 * np.linalg.slogdet(covariances)[1]
    return Mixture(model.getMeans(), np.linalg.inv(covariances), weights)


def _lab(image: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return cv2.cvtColor(image.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB).astype(np.float64)
