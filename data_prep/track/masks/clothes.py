"""The colours of a person's clothes, skin and hair, learned once for a clip.

A single frame does not tell a collar on the mesh's neck from hair. Over the clip, clothes are known beside the neck, skin
on the face and in the middle of the neck, and hair above the mesh. A mixture of normal distributions of each gives the
probability that any other pixel is clothes. The features are CIE L*a*b*, made less dependent on shadows.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_prep.track.masks.neck_zones import Zones

CLIP_FRAMES = 24  # that are learned from, spread over the clip
# Heights above the neck ring, and the distance from the head's axis; 1 is the middle of the head.
_FACE, _FACE_ASIDE = (0.30, 1.00), 0.35
_DARK = 0.1  # share of the face that is left out
_HAIR = 1.1  # above, beside the mesh
_JAW = (0.5, 0.8)
_LONG_HAIR = 0.15  # of the mesh's area at the jaw: with less of the person beside it, no hair falls on the neck
_NECK, _NECK_ASIDE = (0.15, 0.30), 0.12
_CLOTHES = 0.25  # below, beside the mesh
_EDGE = 5  # pixels of the matte's edge, whose colours are mixed
_FEWEST, _MOST = 500, 6000  # pixels that a mixture is made of
_COMPONENTS, _ROUNDS = 4, 30
_NOISE = 4.0  # variance that every component has besides, of L*, a* and b*
# Log odds of clothes at which both are as probable: half of what _PURE of the clothes exceed. Skin in the shade resembles
# clothes more than skin in the light does.
_PURE, _LIKELIER = 0.95, (3.0, 12.0)
_SUREST = 6.0  # log odds beyond which the probability stays


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
    head: tuple[Mixture, ...]  # of the face, of the neck, of hair
    clothes: Mixture
    hair_is_long: bool  # it may fall on the neck and the shoulders
    likelier: float = 0.0  # log odds of clothes at which both are as probable

    def odds(self, colours: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """The logarithm of how many times likelier each colour is of clothes than of skin or hair."""
        head = np.max([mixture.log_density(colours) for mixture in self.head], axis=0)
        return self.clothes.log_density(colours) - head

    def head_share(self, image: UInt8[np.ndarray, "H W 3"], where: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, " N"]:
        """The probability that each pixel of `where` is skin or hair."""
        return 1.0 / (1.0 + np.exp(np.clip(self.odds(_lab(image)[where]) - self.likelier, -_SUREST, _SUREST)))


def learn_colours(clip: Iterable[Zones]) -> Colours | None:
    """The colours of some frames of a clip; None where these show too little of skin or clothes."""
    face, neck, hair, clothes, beside_neck = [], [], [], [], []
    for zones in clip:
        person = cv2.erode(zones.person.astype(np.uint8), np.ones((_EDGE, _EDGE), np.uint8)) > 0
        colours, level = _lab(zones.image), zones.level
        on_mesh, beside = person & zones.inside, person & zones.outside
        face.append(_lightest(colours[on_mesh & (level > _FACE[0]) & (level < _FACE[1]) & (zones.aside < _FACE_ASIDE)]))
        neck.append(colours[on_mesh & (level > _NECK[0]) & (level < _NECK[1]) & (zones.aside < _NECK_ASIDE)])
        hair.append(colours[beside & (level > _HAIR)])
        clothes.append(colours[beside & (level < _CLOTHES)])
        jaw = (level > _JAW[0]) & (level < _JAW[1])
        beside_neck.append(np.count_nonzero(beside & jaw) / max(np.count_nonzero(zones.body & jaw), 1))
    if not face:
        return None
    of_face, of_neck, of_clothes = (_mixture(np.concatenate(parts)) for parts in (face, neck, clothes))
    if of_face is None or of_clothes is None:
        return None
    hair_is_long = bool(np.median(beside_neck) > _LONG_HAIR)
    of_hair = _mixture(np.concatenate(hair)) if hair_is_long else None
    head = tuple(each for each in (of_face, of_neck, of_hair) if each is not None)
    colours = Colours(head, of_clothes, hair_is_long)
    of_most = np.quantile(colours.odds(np.concatenate(clothes)), 1.0 - _PURE)
    return colours._replace(likelier=float(np.clip(0.5 * of_most, *_LIKELIER)))


def _lightest(colours: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    """Without the darkest `_DARK`: brows, nostrils and the mouth's inside."""
    return colours[colours[:, 0] >= np.quantile(colours[:, 0], _DARK)] if len(colours) else colours


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
    """L* scaled down, since shadows change it; a* and b* as they would be at a lightness of 50."""
    lab = cv2.cvtColor(image.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB).astype(np.float64)
    light = lab[..., :1]
    return np.concatenate((0.3 * light, 65.0 * lab[..., 1:] / (light + 15.0)), axis=-1)
