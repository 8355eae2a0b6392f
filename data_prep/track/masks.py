"""Head and mouth masks from the matte and the posed mesh.

The matte has clothes on it; where the neck ends is found by GrabCut inside the matte (Rother, Kolmogorov, Blake 2004), with
the mesh to say what is surely head and what is surely not, the clip's colours to begin from, and along that border
closed-form matting. Everything is measured in heights above the mesh's neck ring.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from avatar.errors import UserError
from data_prep.track.closed_form_matting import band_radius, closed_form, within_limits
from data_prep.track.clothes import Colours
from data_prep.track.faces.landmark_groups import OUTER_LIPS
from data_prep.track.neck_zones import SIDE, Zones

# Heights above the neck ring; 1 is the middle of the head.
_SURELY_CLOTHES = -0.15  # below
_CLOTHES_BESIDE = 0.10  # below and outside the mesh
_MAYBE_BESIDE = 0.50  # below and outside: shoulders, or hair that falls on them
_SURELY_HEAD = 0.30  # above and well inside the mesh
_ALL_HEAD = 0.75  # above, inside the matte
_DIVIDED = 1.0  # below: the rest needs no division
_COLLAR, _MIDDLE = (
    0.45,
    0.12,
)  # below, and so far from the head's axis: clothes on the mesh reach as high, where the colours say so
_NEAR = 1.5  # pixels of SIDE
_HALF = 112  # of 255: pixels that are half head are head, and shares along the collar err by a little
_ITERATIONS = 1  # of GrabCut: three gain 0.0001 of IoU on demo people and take half as long again
_NOWHERE = (255, 0, 255)  # a colour that no person has, in the place of the background


class HeadMask(NamedTuple):
    mask: UInt8[np.ndarray, "H W"]  # 0 or 255, as published masks are
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
    labels = np.full((SIDE, SIDE), cv2.GC_PR_FGD, np.uint8)
    labels[outside & (level < _MAYBE_BESIDE)] = cv2.GC_PR_BGD
    labels[(level < _SURELY_CLOTHES) | (outside & (level < _CLOTHES_BESIDE))] = cv2.GC_BGD
    labels[(inside & (level > _SURELY_HEAD)) | (level > _ALL_HEAD)] = cv2.GC_FGD
    if colours is not None:
        unsure = (
            ~outside & (level >= _SURELY_CLOTHES) & (level < np.where(zones.aside < _MIDDLE, _SURELY_HEAD, _COLLAR))
        )
        labels[unsure] = np.where(colours.are_clothes(zones.image, unsure)[unsure], cv2.GC_PR_BGD, cv2.GC_PR_FGD)
    labels[~person] = cv2.GC_BGD
    small = zones.image.copy()
    small[~person] = _NOWHERE
    _divide(small, labels, level)
    head = _with_face((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD), inside & (level > _ALL_HEAD))
    above = zones.body & (level > _SURELY_HEAD)
    overlap = float(person[above].mean()) if above.any() else 0.0
    person_large = np.where(matte > 127, np.uint8(255), np.uint8(0))
    large = np.where(_nearer_to(head, person & ~head, width, height), person_large, np.uint8(0))
    mask = within_limits(_divided_border, image, large, person_large)
    return HeadMask(np.where(mask > _HALF, person_large, np.uint8(0)), overlap)


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


def _divide(image: np.ndarray, labels: np.ndarray, level: np.ndarray) -> None:
    """GrabCut in place, on the rows that have something to divide."""
    rows = np.flatnonzero((level < _DIVIDED).any(axis=1))
    if not len(rows):
        return
    part = np.ascontiguousarray(labels[rows[0] : rows[-1] + 1])
    known_head, known_other = (part == cv2.GC_FGD).any(), (part == cv2.GC_BGD).any()
    if not (known_head and known_other and ((part == cv2.GC_PR_FGD) | (part == cv2.GC_PR_BGD)).any()):
        return
    cv2.setRNGSeed(0)  # its colour models start from random means
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cut = np.ascontiguousarray(image[rows[0] : rows[-1] + 1])
    cv2.grabCut(cut, part, (0, 0, 0, 0), *models, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    labels[rows[0] : rows[-1] + 1] = part


def _with_face(head: Bool[np.ndarray, "S S"], face: Bool[np.ndarray, "S S"]) -> Bool[np.ndarray, "S S"]:
    """The connected part that holds the face, with its holes filled."""
    _, parts = cv2.connectedComponents(head.astype(np.uint8))
    of_face = parts[face & head]
    if not len(of_face):
        return head
    kept = parts == np.bincount(of_face).argmax()
    outlines, _ = cv2.findContours(kept.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(kept.astype(np.uint8), outlines, -1, 1, cv2.FILLED) > 0
