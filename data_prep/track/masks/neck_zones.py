"""A frame divided by where its pixels lie about the posed mesh's neck: by height above its ring, and by its outline."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from data_prep.prepare.projection import silhouette

SIDE = 256  # pixels of the picture that is divided; the division is enlarged
_MARGIN_IN, _MARGIN_OUT = 7, 5  # pixels of SIDE by which the mesh may be wrong


class Zones(NamedTuple):
    image: UInt8[np.ndarray, "S S 3"]
    person: Bool[np.ndarray, "S S"]  # the matte
    body: Bool[np.ndarray, "S S"]  # the mesh's outline
    inside: Bool[np.ndarray, "S S"]  # well inside of it
    outside: Bool[np.ndarray, "S S"]  # well outside
    level: Float[np.ndarray, "S S"]  # height above the ring along the head's axis; 1 is the middle of the head
    aside: Float[np.ndarray, "S S"]  # distance from that axis in the same unit


def zones_of(
    image: UInt8[np.ndarray, "H W 3"],
    matte: UInt8[np.ndarray, "H W"],
    screen: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    ring: Int[np.ndarray, " R"],
) -> Zones:
    """`screen` are the posed vertices in pixels of the image (centres at +0.5), `ring` those of the neck ring."""
    height, width = matte.shape
    small_screen = screen * np.array([SIDE / width, SIDE / height, 1.0])
    body = silhouette(small_screen, faces, SIDE, SIDE)
    level, aside = _about_axis(screen[:, :2], ring, width, height)
    return Zones(
        image=cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA),
        person=cv2.resize(matte, (SIDE, SIDE), interpolation=cv2.INTER_AREA) > 127,
        body=body > 0,
        inside=cv2.erode(body, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_MARGIN_IN, _MARGIN_IN))) > 0,
        outside=cv2.dilate(body, np.ones((_MARGIN_OUT, _MARGIN_OUT), np.uint8)) == 0,
        level=level,
        aside=aside,
    )


def _about_axis(
    points: np.ndarray, ring: np.ndarray, width: int, height: int
) -> tuple[Float[np.ndarray, "S S"], Float[np.ndarray, "S S"]]:
    """Every pixel's height above the ring along the head's axis, and its distance from it, in the image's own pixels: those
    of SIDE may be wider than high."""
    base = points[ring].mean(0)
    axis = points.mean(0) - base
    axis = axis / max(float(axis @ axis), 1e-9)
    rows, columns = np.mgrid[0:SIDE, 0:SIDE] + 0.5
    x, y = columns * (width / SIDE) - base[0], rows * (height / SIDE) - base[1]
    return x * axis[0] + y * axis[1], np.abs(x * axis[1] - y * axis[0])
