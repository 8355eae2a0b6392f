"""A folder of numbered PNG or JPEG pictures as footage."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from avatar.data.read_image import (
    IMAGE_SUFFIXES,
    OTHER_PICTURES,
    decode_image,
    decode_transparency,
    has_transparency,
    read_bytes,
    read_image,
)
from avatar.errors import UserError
from avatar.files.names import natural_order
from data_prep.track.footage.source import LAID_OVER_GREY, Footage, Span, TimedPicture, View, check_size, opaque, stride
from data_prep.track.footage.timing import DEFAULT_FPS
from data_prep.track.footage.video import open_video

_MAX_PICTURES = 100_000
_TRACKED = {"imgs", "images", "image", "frames", "checkpoint", "flame_param"}  # what tracked folders hold
_EXIF, _FOCAL_IN_35MM_FILM = 0x8769, 0xA405  # EXIF 2.3, tags of the sub-directory and of the value


def read_picture(file: Path) -> tuple[np.ndarray, bool]:
    """A picture, and whether it has transparent parts, which are laid over grey."""
    data = read_bytes(file)
    image = decode_image(data, file)
    if not has_transparency(data):
        return image, False
    matte = decode_transparency(data, file)
    return (image, False) if matte.min() == 255 else (opaque(np.dstack((image, matte))), True)


@dataclass(frozen=True)
class PictureFolder(Footage):
    """The pictures are taken in the order of their numbers, `rate` a second, or at the `times` where there are any."""

    rate: float
    files: tuple[Path, ...]
    decode: Callable[[Path], tuple[np.ndarray, bool]] = read_picture
    times: tuple[float, ...] = ()  # seconds, of each file

    def read(
        self, view: View, span: Span, complain: Callable[[str], object], every: int | None = None
    ) -> Iterator[TimedPicture]:
        """Raises UserError for pictures of another size and for files that cannot be decoded."""
        was_transparent = False
        times = self.times or [n / self.rate for n in range(len(self.files))]
        both = zip(times, self.files, strict=True)
        inside = [(t, f) for t, f in both if t >= span.start - 1e-6 and (span.end is None or t < span.end - 1e-6)]
        for time, file in inside[:: every or stride(self.rate)]:
            image, is_transparent = self.decode(file)
            was_transparent |= is_transparent
            if image.shape[:2] != (self.height, self.width):
                raise UserError(
                    f"{file} is {image.shape[1]}x{image.shape[0]} pixels but {self.files[0].name} is "
                    f"{self.width}x{self.height}; give pictures of one size"
                )
            yield TimedPicture(time, resampled(image, view))
        if was_transparent:
            complain(LAID_OVER_GREY)

    @cached_property
    def content_hash(self) -> str:
        digest = hashlib.sha256()
        for file in self.files:
            digest.update(file.name.encode(errors="surrogateescape") + b"\0" + read_bytes(file))
        return digest.hexdigest()


def resampled(image: np.ndarray, view: View) -> np.ndarray:
    """The view of a whole picture; made smaller by the mean over areas."""
    box = view.box
    part = image[box.y : box.y + box.height, box.x : box.x + box.width]
    if part.shape[:2] == (view.height, view.width):
        return np.ascontiguousarray(part)
    smaller = view.width < box.width
    return cv2.resize(part, (view.width, view.height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


def open_footage(path: Path) -> Footage:
    """A video file or a folder of pictures. Raises UserError for what is neither."""
    return open_pictures(path) if path.is_dir() else open_video(path)


def is_footage(path: Path) -> bool:
    """Whether the path is something to be tracked: a file, or a folder of pictures that is nobody's tracked folder."""
    if not path.is_dir():
        return path.is_file()
    names = [entry.name.lower() for entry in path.iterdir()]
    is_tracked = any(name in _TRACKED or name.endswith(".json") for name in names)
    return not is_tracked and any(Path(name).suffix in IMAGE_SUFFIXES for name in names)


def open_pictures(folder: Path) -> PictureFolder:
    try:
        found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    except OSError as error:
        raise UserError(f"{folder} cannot be read ({error.strerror})") from None
    files = tuple(sorted((p for p in found if not p.is_dir()), key=lambda path: natural_order(path.name)))
    if not files:
        inside = next((name for name in ("imgs", "frames", "images") if (folder / name).is_dir()), None)
        hint = f"; it looks like a tracked folder: give {folder / inside} to track its pictures again" if inside else ""
        others = sorted({p.suffix.lower() for p in folder.iterdir()} & set(OTHER_PICTURES))
        if others and not hint:
            raise UserError(f"{folder} holds {' and '.join(others)} files; convert them to PNG")
        raise UserError(f"{folder} holds no PNG or JPEG pictures{hint or ' and is not a video'}")
    if len(files) > _MAX_PICTURES:
        raise UserError(f"{folder} holds {len(files)} pictures; more than {_MAX_PICTURES} are not read")
    return footage_of(folder, files)


def footage_of(path: Path, files: tuple[Path, ...]) -> PictureFolder:
    """Pictures in the order of their times; `path` names them."""
    first = read_image(files[0])
    height, width = first.shape[:2]
    check_size(files[0], width, height)
    note = f"a folder of pictures has no frame rate: {DEFAULT_FPS:g} a second are assumed"
    duration = len(files) / DEFAULT_FPS
    return PictureFolder(path, width, height, DEFAULT_FPS, duration, _focal_of(files[0]), (note,), files)


def _focal_of(file: Path) -> float | None:
    from PIL import Image  # comes with imageio; only the header is read

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(file) as image:
                value = float(image.getexif().get_ifd(_EXIF).get(_FOCAL_IN_35MM_FILM, 0))
    except Exception:  # a header may be damaged in many ways, and nothing depends on it
        return None
    return value if 5 <= value <= 1200 else None
