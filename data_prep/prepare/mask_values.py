"""What the values of mask files mean: 0 to 255, or the labels of a segmentation program.

Masks of video-object segmentation are palette or grey PNGs in which 0 is the background and a small number the person. Read
as grey they are nearly black, and the person would be learned as nearly transparent. With one such number in all files
they are read as 0 and 255; anything else that is not a mask is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from avatar.data.read_image import decode_image, decode_values, read_bytes
from avatar.errors import UserError
from data_prep.formats.frame_files import ALPHA, HEAD, MOUTH, FrameFiles
from data_prep.formats.tracked_folder import Shot, spread_by_camera

SAMPLES = 16  # files of each kind
LEAST_BRIGHT, FULL = 200, 250  # the largest value of a mask: below, it is none; below, it is said
MOST_DARK = 25  # the least value of a mask
_COLOURED = 64  # difference of the channels; JPEG's noise on grey stays below 20
_ROUNDED = 16  # JPEG's own luminance against that of its colours
_COLOURED_SHARE = 0.005  # of the pixels
_SHOWN = 6  # values in a sentence
WHAT = {ALPHA: "mattes", HEAD: "head masks", MOUTH: "mouth masks"}


def with_labels(files: FrameFiles, shots: Mapping[int, Shot] | None = None) -> tuple[FrameFiles, list[str]]:
    """The files with the labels that stand for 255 in each kind of mask, and a sentence about each that the layout does not
    tell."""
    labels, notes = dict(files.labels), []
    for kind, paths in mask_kinds(files).items():
        label = None if kind in labels else only_label(_values_of_some(paths, shots))
        if label is not None:
            labels[kind] = label
            notes.append(f"the {WHAT[kind]} in {place_of(paths)} are label images: {label} is read as 255")
    return replace(files, labels=labels), notes


def mask_kinds(files: FrameFiles) -> dict[str, dict[int, Path]]:
    """Files that are masks of their own, by kind: not the images' transparency, not classes."""
    kinds = {ALPHA: {} if files.is_transparent else files.alphas, HEAD: files.head_masks, MOUTH: files.mouth_masks}
    return {kind: paths for kind, paths in kinds.items() if paths}


def refuse_colours(files: FrameFiles, shots: Mapping[int, Shot] | None = None) -> None:
    """Raises UserError where pictures in colour stand in for masks, as cut-outs on a plain background do."""
    for kind, paths in mask_kinds(files).items():
        for number in spread_by_camera(paths, SAMPLES, shots):
            if kind not in files.labels and _is_coloured(paths[number]):
                raise UserError(coloured_sentence(str(paths[number]), WHAT[kind]))


def coloured_sentence(place: str, masks: str) -> str:
    return (
        f"{place} is a picture in colour, not one of the {masks}: make masks of 0 and 255, or PNGs whose transparency is "
        "the mask"
    )


def judge_values(kind: str, paths: Mapping[int, Path], darkest: int, brightest: int) -> tuple[str | None, str | None]:
    """From the least and the largest value of all masks of a kind: what makes them useless, with what to do about it; and
    what should be known of them."""
    masks = f"the {WHAT[kind]} in {place_of(paths)}"
    if brightest == 0 and kind == MOUTH:
        return None, f"{masks} are all black: the mouth gets no weight of its own"
    return judge_range(masks, darkest, brightest, lambda: _values_of_some(paths))


def judge_range(
    masks: str, darkest: int, brightest: int, values: Callable[[], Iterable[set[int]]]
) -> tuple[str | None, str | None]:
    """The same of masks that must show somebody; `values` are those of some of them."""
    if brightest == 0:
        return f"{masks} are all black: nobody is in them; make them again", None
    if brightest < LEAST_BRIGHT:
        found = sorted(set().union(*values()))
        shown = ", ".join(map(str, found[:_SHOWN])) + (" ..." if len(found) > _SHOWN else "")
        return (
            f"{masks} reach only {brightest} of 255 (values {shown}): what they show would be transparent; make the person "
            "255 and all else 0"
        ), None
    if MOST_DARK < darkest < brightest:
        return f"{masks} are nowhere below {darkest} of 255: the background would shine through; make it 0", None
    if brightest < FULL:
        return None, f"{masks} reach only {brightest} of 255: the avatar will be a little transparent"
    return None, None


def only_label(values: Iterable[set[int]]) -> int | None:
    """The one value below 255 that all files hold besides 0, if there is no other."""
    found = set().union(*values)
    others = found - {0}
    return others.pop() if 0 in found and len(others) == 1 and max(others) < 255 else None


def _values_of_some(paths: Mapping[int, Path], shots: Mapping[int, Shot] | None = None) -> list[set[int]]:
    found = []
    for path in (paths[number] for number in spread_by_camera(paths, SAMPLES, shots)):
        try:
            found.append(set(np.unique(decode_values(read_bytes(path), path)).tolist()))
        except UserError:
            continue  # damaged: named when all of them are read
    return found


def _is_coloured(path: Path) -> bool:
    try:
        return is_coloured(decode_image(read_bytes(path), path), decode_values(read_bytes(path), path))
    except UserError:
        return False


def is_coloured(pixels: np.ndarray, values: np.ndarray) -> bool:
    """Whether a file [H, W, 3] whose `values` [H, W] would be its mask is a picture in colour."""
    luminance = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    if np.abs(values.astype(np.int16) - luminance).max() > _ROUNDED:
        return False  # the mask is its transparency, or a palette's indices
    spread = pixels.max(axis=2).astype(np.int16) - pixels.min(axis=2)
    return bool((spread > _COLOURED).mean() > _COLOURED_SHARE)


def place_of(paths: Mapping[int, Path]) -> Path:
    return next(iter(paths.values())).parent
