"""Head and mouth masks from the matte and the posed mesh.

The matte has clothes on it. The mesh says what is surely head and what is surely clothes; between these, the clip's colours
give each pixel a probability, which closed-form matting makes consistent with the picture's edges. Everything is measured
in heights above the mesh's neck ring.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.ndimage import distance_transform_edt

from avatar.data.subject import FAINTEST_MATTE
from avatar.errors import UserError
from data_prep.track.faces.landmark_groups import OUTER_LIPS
from data_prep.track.masks.clothes import Colours
from data_prep.track.masks.neck_zones import Zones
from data_prep.track.mattes.closed_form_matting import band_radius, closed_form, within_limits

# Heights above the neck ring; 1 is the middle of the head.
_SURELY_CLOTHES = -0.15  # below
_CLOTHES_BESIDE = 0.10  # below and far outside the mesh
_MAYBE_BESIDE = 0.50  # below and outside: shoulders, or hair that falls on them; above and beside the mesh: hair
_REACH = 17  # pixels of SIDE across: beside the mesh, which may lie so far aside
_SURELY_HEAD = 0.30  # above and well inside the mesh
_ALL_HEAD = 0.75  # above, inside the matte
_COLLAR, _MIDDLE = 0.45, 0.12  # below, farther than _MIDDLE from the head's axis: a collar on the mesh reaches as high
_NEAR = 1.5  # pixels of SIDE
_THREAD = 7  # pixels of SIDE: thinner parts are shadows along a collar, not hair
_TRUST = 0.1  # in the colours of one pixel, against its neighbours


class HeadMask(NamedTuple):
    mask: UInt8[np.ndarray, "H W"]  # soft along the collar; along the person's outline the matte is
    overlap: float  # share of the mesh (above the ring) that lies on the matte


def neck_ring(template: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " R"]:
    """Vertices of the mesh's lowest open edge. Raises UserError for a mesh that is open nowhere."""
    edges = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    _, inverse, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    follows = dict(edges[count[inverse.ravel()] == 1].tolist())
    loops = []
    while follows:
        start, at = follows.popitem()
        loop = [start]
        while at in follows:
            loop.append(at)
            at = follows.pop(at)
        loops.append(loop)
    if not loops:
        raise UserError("the head model is closed everywhere: it has no neck ring to end the head mask at")
    return np.array(min(loops, key=lambda loop: template[loop, 1].mean()), np.int64)


def head_mask(
    image: UInt8[np.ndarray, "H W 3"], matte: UInt8[np.ndarray, "H W"], zones: Zones, colours: Colours | None = None
) -> HeadMask:
    """Head and neck of the person in `matte`; `zones` are the image's, `colours` its clip's where they are known."""
    height, width = matte.shape
    person, inside, outside, level = zones.person, zones.inside, zones.outside, zones.level
    beside = cv2.dilate(zones.body.astype(np.uint8), np.ones((_REACH, _REACH), np.uint8)) > 0
    # Far beside the neck there is nothing of the head but long hair: hands have the colours of skin.
    is_short = colours is not None and not colours.hair_is_long
    clothes = (level < _SURELY_CLOTHES) | (~beside & (level < (_MAYBE_BESIDE if is_short else _CLOTHES_BESIDE)))
    sure = (inside & (level > np.where(zones.aside < _MIDDLE, _SURELY_HEAD, _COLLAR))) | (level > _ALL_HEAD)
    sure |= beside & (level > _MAYBE_BESIDE)
    unsure = person & ~clothes & ~sure
    share = np.where(clothes, np.float32(0.0), np.float32(1.0))
    if colours is not None:
        share[unsure] = colours.head_share(zones.image, unsure)
    else:
        share[(outside & (level < _MAYBE_BESIDE)) | (level < 0.0)] = 0.0
    share = closed_form(zones.image, _continued(share, person), unsure, trust=_TRUST)
    head = _with_face(_without_threads(person & (share > 0.5), unsure), inside & (level > _ALL_HEAD))
    above = zones.body & (level > _SURELY_HEAD)
    overlap = float(person[above].mean()) if above.any() else 0.0
    person_large = np.where(matte > 127, np.uint8(255), np.uint8(0))
    large = np.where(_nearer_to(head, person & ~head, width, height), np.uint8(255), np.uint8(0))
    mask = within_limits(_divided_border, image, large, person_large)
    return HeadMask(np.where(matte >= FAINTEST_MATTE, mask, np.uint8(0)), overlap)


def mouth_mask(points: Float32[np.ndarray, "478 3"], width: int, height: int) -> UInt8[np.ndarray, "H W"]:
    """255 inside the outer outline of the lips; `points` are the landmarks in pixels."""
    mask = np.zeros((height, width), np.uint8)
    outline = np.clip(points[list(OUTER_LIPS), :2], -(2**13), 2**13)
    corners = np.rint((outline - 0.5) * 16).astype(np.int32)
    return cv2.fillPoly(mask, [corners], 255, shift=4)


def _nearer_to(
    head: Bool[np.ndarray, "S S"], clothes: Bool[np.ndarray, "S S"], width: int, height: int
) -> Bool[np.ndarray, "H W"]:
    """Where the head is nearer than clothes are: the finer matte has pixels that neither covers."""
    difference = cv2.GaussianBlur(head.astype(np.float32) - clothes.astype(np.float32), (0, 0), _NEAR)
    return cv2.resize(difference, (width, height), interpolation=cv2.INTER_LINEAR) > 0


def _divided_border(image: np.ndarray, head: np.ndarray, person: np.ndarray) -> UInt8[np.ndarray, "H W"]:
    """The head's mask with the colours' share of each pixel where it borders on clothes."""
    reach = 2 * band_radius(*head.shape) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    is_head = (head > 127).astype(np.uint8)
    is_clothes = ((person > 127) & (is_head == 0)).astype(np.uint8)
    band = (cv2.dilate(is_head, disc) > 0) & (cv2.dilate(is_clothes, disc) > 0)
    return np.rint(closed_form(image, is_head.astype(np.float32), band) * 255.0).astype(np.uint8)


def _continued(share: Float32[np.ndarray, "S S"], person: Bool[np.ndarray, "S S"]) -> Float32[np.ndarray, "S S"]:
    """The share of every pixel of the person, and elsewhere that of the nearest of these."""
    if not person.any():
        return share
    nearest = np.asarray(distance_transform_edt(~person, return_distances=False, return_indices=True))
    return share[nearest[0], nearest[1]]


def _without_threads(head: Bool[np.ndarray, "S S"], unsure: Bool[np.ndarray, "S S"]) -> Bool[np.ndarray, "S S"]:
    """Without the unsure parts that are thinner than `_THREAD`."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_THREAD, _THREAD))
    return head & ~(unsure & (cv2.morphologyEx(head.astype(np.uint8), cv2.MORPH_OPEN, disc) == 0))


def _with_face(head: Bool[np.ndarray, "S S"], face: Bool[np.ndarray, "S S"]) -> Bool[np.ndarray, "S S"]:
    """The connected part that holds the face, with its holes filled."""
    _, parts = cv2.connectedComponents(head.astype(np.uint8))
    of_face = parts[face & head]
    if not len(of_face):
        return head
    kept = parts == np.bincount(of_face).argmax()
    outlines, _ = cv2.findContours(kept.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(kept.astype(np.uint8), outlines, -1, 1, cv2.FILLED) > 0
