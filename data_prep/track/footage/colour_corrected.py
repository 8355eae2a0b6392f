"""Footage whose colours are corrected by the polynomial of Cheung et al. (2004), in linear light."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from data_prep.track.footage.source import Footage, Span, TimedPicture, View, common_fields
from data_prep.track.stage_folder import hash_of

Terms = tuple[tuple[int, int, int], ...]  # exponents of R, G and B
_ONE: Terms = ((0, 0, 0),)
_RGB: Terms = ((1, 1, 1),)
_CUBES: Terms = ((3, 0, 0), (0, 3, 0), (0, 0, 3))
_3: Terms = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
_6: Terms = (*_3, (1, 1, 0), (1, 0, 1), (0, 1, 1))
_9: Terms = (*_6, (2, 0, 0), (0, 2, 0), (0, 0, 2))
_13: Terms = (*_9, *_RGB, (2, 1, 0), (0, 2, 1), (1, 0, 2))
_16: Terms = (*_13, (2, 0, 1), (1, 2, 0), (0, 1, 2))
_ALL: tuple[Terms, ...] = (
    _3,
    (*_3, *_ONE),
    (*_3, *_RGB, *_ONE),
    (*_6, *_ONE),
    (*_6, *_RGB, *_ONE),
    (*_9, *_ONE),
    (*_9, *_RGB, *_ONE),
    (*_9, *_RGB, *_CUBES, *_ONE),
    (*_13, *_CUBES),
    (*_13, *_CUBES, *_ONE),
    (*_16, *_CUBES),
    (*_16, *_CUBES, *_ONE),
    (*_16, *_CUBES, (2, 1, 1), (1, 2, 1), (1, 1, 2)),
)
TERMS = {len(terms): terms for terms in _ALL}
"""By their number; as in colour-science's `matrix_augmented_Cheung2004`."""


def _decoded(encoded: np.ndarray) -> np.ndarray:
    """Linear light of sRGB's values (IEC 61966-2-1), both from 0 to 1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encoded(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


_PIXELS = 10_000  # at a time, whose terms stay in the processor's cache
_STEPS = 2**16 - 1  # of linear light, in each of which sRGB's value rises by 0.05 levels at most
_DECODE = _decoded(np.arange(256) / 255).astype(np.float32)
_ENCODE = np.round(255 * _encoded(np.arange(_STEPS + 1) / _STEPS)).astype(np.uint8)


@dataclass(frozen=True)
class ColourCorrected(Footage):
    footage: Footage
    matrix: np.ndarray  # [3, T] for T of TERMS

    def read(
        self, view: View, span: Span, complain: Callable[[str], object], every: int | None = None
    ) -> Iterator[TimedPicture]:
        for picture in self.footage.read(view, span, complain, every):
            yield picture._replace(image=correct_colours(picture.image, self.matrix))

    @cached_property
    def content_hash(self) -> str:
        return hash_of([self.footage.content_hash, self.matrix.tolist()])


def colour_corrected(footage: Footage, matrix: Float[np.ndarray, "3 T"], path: Path) -> ColourCorrected:
    """`path` is the matrix's file, which the notes name."""
    values = common_fields(footage)
    values |= {"notes": (*footage.notes, f"colours are corrected by {path}")}
    return ColourCorrected(**values, footage=footage, matrix=matrix)


def correct_colours(image: UInt8[np.ndarray, "H W 3"], matrix: Float[np.ndarray, "3 T"]) -> UInt8[np.ndarray, "H W 3"]:
    """The matrix times the terms of each linear colour; both images are sRGB."""
    pixels, corrected, factors = image.reshape(-1, 3), np.empty_like(image), matrix.astype(np.float32)
    for start in range(0, len(pixels), _PIXELS):
        part = slice(start, start + _PIXELS)
        linear = cv2.LUT(np.ascontiguousarray(pixels[part].T), _DECODE)
        steps = np.clip(factors @ augmented(linear, matrix.shape[1]), 0, 1) * _STEPS + 0.5
        corrected.reshape(-1, 3)[part] = np.take(_ENCODE, steps.astype(np.uint16)).T
    return corrected


def augmented(colours: Float[np.ndarray, "3 N"], count: int) -> Float[np.ndarray, "T N"]:
    """The `count` terms of each colour."""
    terms = np.ones((count, colours.shape[1]), colours.dtype)
    for term, exponents in zip(terms, TERMS[count], strict=True):
        for colour, exponent in zip(colours, exponents, strict=True):
            for _ in range(exponent):
                term *= colour
    return terms
