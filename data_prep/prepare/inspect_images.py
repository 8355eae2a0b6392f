"""A look at every image and mask of a tracked folder: can it be decoded, and does it have the size of the others?"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.compute.processors import processor_count
from avatar.data.read_image import read_bytes, read_image
from avatar.errors import UserError
from data_prep.formats import face_parsing
from data_prep.formats.face_parsing import mask_of
from data_prep.formats.frame_files import ALPHA, HEAD, IMAGE, MOUTH, PARSING, TRACKING, FrameFiles
from data_prep.formats.frame_track import Tracking
from data_prep.formats.tracked_folder import Shot
from data_prep.prepare.mask_values import judge_values, mask_kinds, refuse_colours

_SAMPLES = 16
_ONE = {ALPHA: "alpha", HEAD: "head mask", MOUTH: "mouth mask", PARSING: "face parsing"}
_BACKGROUNDS = {"white": (255, 255, 255), "black": (0, 0, 0), "green": (0, 255, 0)}
_BACKGROUND_TOLERANCE = 3.0  # of 255, mean; JPEG noise on a flat colour is below 1
_MIN_BACKGROUND = 0.02  # of the image; with less there is nothing to judge by


@dataclass(frozen=True)
class Inspection:
    width: int  # of the first image
    height: int
    sizes: dict[int, tuple[int, int]]  # image number -> width, height
    digests: dict[int, bytes]  # image number -> hash of the contents of image and masks
    image_digests: dict[int, bytes]
    bad: dict[int, str]  # image number -> why it cannot be used
    notes: tuple[str, ...]  # what should be known of the masks


@dataclass(frozen=True)
class _Seen:
    digest: bytes
    size: tuple[int, int]  # width, height; (0, 0) where undecodable
    darkest: int  # of a face parsing's head mask
    brightest: int
    problem: str | None


def inspect_images(files: FrameFiles, shots: Mapping[int, Shot] | None = None) -> Inspection:
    """Decode everything once. Raises UserError when sizes differ within a camera or masks are not 0 to 255, naming both."""
    refuse_colours(files, shots)
    images = _look_at(files, IMAGE, files.images)
    bad = {n: seen.problem for n, seen in images.items() if seen.problem is not None}
    sizes = {n: seen.size for n, seen in images.items() if seen.problem is None}
    if not sizes:
        raise UserError(
            f"none of the {len(images)} images in {next(iter(files.images.values())).parent} can be read: "
            f"{next(iter(bad.values()))}"
        )
    first_of: dict[str, int] = {}
    for number, size in sizes.items():
        first = first_of.setdefault(shots[number].camera if shots else "", number)
        if size != sizes[first]:
            raise UserError(
                f"{files.images[number]} is {_x(size)} pixels but {files.images[first].name} is {_x(sizes[first])}; "
                f"all frames{' of a camera' if shots else ''} must have one size"
            )
    digests = {n: [seen.digest] for n, seen in images.items()}
    notes: list[str] = []
    own_masks = mask_kinds(files)
    for kind, paths in files.of_kind().items():
        if not paths or kind in (IMAGE, TRACKING):
            continue
        masks = _look_at(files, kind, {n: p for n, p in paths.items() if n in files.images})
        for number, seen in masks.items():
            digests[number].append(seen.digest)
            if seen.problem is not None:
                bad.setdefault(number, seen.problem)
            elif seen.size != sizes.get(number, seen.size):
                raise UserError(
                    f"{paths[number]} is {_x(seen.size)} pixels but the images are {_x(sizes[number])}; "
                    "make the masks at the size of the images"
                )
            elif kind != MOUTH and seen.brightest == 0:
                bad.setdefault(number, f"{paths[number].name} is empty: no head was found")
        whole = [seen for seen in masks.values() if seen.problem is None]
        if kind in own_masks and whole:
            values = min(seen.darkest for seen in whole), max(seen.brightest for seen in whole)
            problem, note = judge_values(kind, paths, *values)
            if problem is not None:
                raise UserError(problem)
            notes += [note] if note else []
        for number in files.images.keys() - masks.keys():
            bad.setdefault(number, f"it has no {_ONE[kind]}")
    width, height = next(iter(sizes.values()))
    return Inspection(
        width=width,
        height=height,
        sizes=sizes,
        digests={n: hashlib.blake2b(b"".join(parts), digest_size=16).digest() for n, parts in digests.items()},
        image_digests={n: seen.digest for n, seen in images.items()},
        bad=dict(sorted(bad.items())),
        notes=tuple(notes),
    )


def check_sizes(files: FrameFiles, tracks: Tracking, inspection: Inspection, is_rig: bool) -> None:
    """Raise UserError where the tracking is not of the images' size."""
    for number, track in tracks.frames.items():
        size = inspection.sizes.get(number) if is_rig else (inspection.width, inspection.height)
        if size not in (None, track.size):
            seen = (
                f"{files.images[number]} is" if is_rig else f"those in {next(iter(files.images.values())).parent} are"
            )
            of_rig = "give each listed frame the w and h of its camera's images, " if is_rig else ""
            raise UserError(
                f"the tracking was made on {track.size[0]}x{track.size[1]} images, but {seen} {size[0]}x{size[1]}; "
                f"{of_rig}resize the images or track them again"
            )


def composited_background(files: FrameFiles, bad: Mapping[int, str]) -> str | None:
    """The name of the flat colour that lies behind the person in all sampled frames, or None.

    Frames that were composited before they were matted have alpha squared at their edges when composited again.
    """
    usable = [n for n in files.images if n in files.alphas and n not in bad]
    sums, count, pixels = np.zeros((len(_BACKGROUNDS),)), 0, 0
    for number in usable[:: max(1, len(usable) // _SAMPLES)]:
        matte = files.read(ALPHA, number)
        assert matte is not None
        background = matte <= 2
        colours = read_image(files.images[number])[background].astype(np.float64)
        for i, flat in enumerate(_BACKGROUNDS.values()):
            sums[i] += np.abs(colours - flat).sum() / 3
        count += len(colours)
        pixels += background.size
    if count < _MIN_BACKGROUND * max(pixels, 1):
        return None
    nearest = int(sums.argmin())
    return list(_BACKGROUNDS)[nearest] if sums[nearest] / count <= _BACKGROUND_TOLERANCE else None


def _look_at(files: FrameFiles, kind: str, paths: Mapping[int, Path]) -> dict[int, _Seen]:
    def look(path: Path) -> _Seen:
        data = b""
        try:
            data = read_bytes(path)
            pixels = files.decode(kind, data, path)
            pixels = mask_of(pixels, face_parsing.HEAD) if kind == PARSING else pixels
        except UserError as error:
            return _Seen(hashlib.blake2b(data, digest_size=16).digest(), (0, 0), 0, 0, str(error))
        height, width = pixels.shape[:2]
        values = int(pixels.min()), int(pixels.max())
        return _Seen(hashlib.blake2b(data, digest_size=16).digest(), (width, height), *values, None)

    with ThreadPoolExecutor(processor_count()) as pool:  # decoding releases the interpreter lock
        return dict(zip(paths, pool.map(look, paths.values()), strict=True))


def _x(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
