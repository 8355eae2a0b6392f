"""What one image with its masks shows: can they be read, how do they fit together, what light is in them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from skimage.measure import label

from avatar.data.read_image import read_bytes
from avatar.data.subject import head_of_matte
from avatar.errors import UserError
from data_prep.formats import face_parsing
from data_prep.formats.face_parsing import mask_of
from data_prep.formats.frame_files import ALPHA, HEAD, IMAGE, PARSING
from data_prep.prepare.mask_overlap import measured_size
from data_prep.prepare.projection import filled

FAR = 0.05  # of the image width: further from the person than soft hair reaches
_ON = 127
_MIN_PIXELS = 64  # below, a mean colour says nothing


@dataclass(frozen=True)
class Matte:
    """The weight that training gives each pixel: matte times head mask, as `Frame.composite` does."""

    covered: float  # share of the image with a weight above one half
    haze: float  # mean weight far from the person; 0 where the background is gone
    holes: float  # share of the inner head mask that the matte makes transparent; of the person where there is none
    specks: float  # area of everything but the largest piece / area of the largest piece


@dataclass(frozen=True)
class View:
    problems: dict[str, str] = field(default_factory=dict)  # kind of file -> why it cannot be read
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)  # kind -> width, height
    darkest: dict[str, int] = field(default_factory=dict)  # kind of mask -> its least value
    brightest: dict[str, int] = field(default_factory=dict)  # and its largest
    digest: bytes = b""  # of the image file
    grey: np.ndarray | None = None  # uint8 [h, w] at the measured size
    head_colour: np.ndarray | None = None  # float [3], mean over the head mask
    background_colour: np.ndarray | None = None  # float [3], mean over what the matte calls background
    matte: Matte | None = None
    cut: float = 0.0  # share of the picture's upper edge that the head mask covers


def look_at(paths: Mapping[str, Path], decode: Callable[[str, bytes, Path], np.ndarray]) -> View:
    """Decode the files of one frame (kind -> path, the image among them) and measure them. Raises nothing.

    decode  gives the pixels of a kind's file; of PARSING classes, out of which the head mask is made
    """
    problems: dict[str, str] = {}
    pixels: dict[str, np.ndarray] = {}
    digest = b""
    for kind, path in paths.items():
        try:
            data = read_bytes(path)
            pixels[kind] = decode(kind, data, path)
        except UserError as error:
            problems[kind] = str(error)
            continue
        if kind == IMAGE:
            digest = hashlib.blake2b(data, digest_size=16).digest()
    sizes = {kind: (array.shape[1], array.shape[0]) for kind, array in pixels.items()}
    if PARSING in pixels:
        pixels[HEAD] = mask_of(pixels.pop(PARSING), face_parsing.HEAD)
    darkest, brightest = (
        {kind: int(extreme(array)) for kind, array in pixels.items() if kind != IMAGE} for extreme in (np.min, np.max)
    )
    if IMAGE not in pixels:
        return View(problems, sizes, darkest, brightest, digest)
    width, height = sizes[IMAGE]
    size = measured_size(width, height)
    small = {
        kind: array if size == (width, height) else cv2.resize(array, size, interpolation=cv2.INTER_AREA)
        for kind, array in pixels.items()
        if array.shape[:2] == (height, width)
    }
    image, alpha, head = small[IMAGE], small.get(ALPHA), small.get(HEAD)
    matte = None
    if head is None and alpha is not None and not {HEAD, PARSING} & paths.keys():
        head = head_of_matte(alpha)
        matte = measure_matte(alpha, head, filled(alpha > _ON))  # its soft rim is no hole
    elif alpha is not None and head is not None:
        matte = measure_matte(alpha, head, head > _ON)
    elif head is not None and ALPHA not in paths:
        matte = measure_matte(np.full_like(head, 255), head, head > _ON)
    return View(
        problems,
        sizes,
        darkest,
        brightest,
        digest,
        grey=cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
        head_colour=None if head is None else _mean_colour(image, head > _ON),
        background_colour=None if alpha is None else _mean_colour(image, alpha <= 2),
        matte=matte,
        cut=0.0 if head is None else float((head[0] > _ON).mean()),
    )


def measure_matte(alpha: np.ndarray, head: np.ndarray, solid: np.ndarray) -> Matte:
    """From matte and head mask, uint8 [h, w], and where the matte should have no hole, bool [h, w]."""
    weight = alpha.astype(np.float32) * head * (1 / 255**2)
    on = weight > 0.5
    apart = cv2.distanceTransform((~on).astype(np.uint8), cv2.DIST_L2, 3)
    far = apart > FAR * weight.shape[1]  # everywhere, where nobody is
    border = max(3, round(0.04 * weight.shape[1])) | 1
    inner = cv2.erode(solid.astype(np.uint8), np.ones((border, border), np.uint8)) > 0
    areas = np.sort(np.bincount(np.asarray(label(on)).ravel())[1:])[::-1]  # of the pieces; 0 is what lies around
    return Matte(
        covered=float(on.mean()),
        haze=float(weight[far].mean()) if far.any() else 0.0,
        holes=float((alpha[inner] <= _ON).mean()) if inner.any() else 0.0,
        specks=float(areas[1:].sum() / areas[0]) if len(areas) else 0.0,
    )


def _mean_colour(image: np.ndarray, where: np.ndarray) -> np.ndarray | None:
    return image[where].mean(axis=0) if int(where.sum()) >= _MIN_PIXELS else None
