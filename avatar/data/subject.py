"""A prepared subject -> frames, decoded when they are asked for."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.frame import Frame
from avatar.data.manifest import GIVEN, TRACKS_FILE, FrameRecord, Manifest, read_manifest
from avatar.data.read_image import read_image, read_mask, read_matte
from avatar.data.recording import Recording, checked_tracks
from avatar.data.split import Split
from avatar.data.tensor_file import read_tensors
from avatar.errors import UserError
from avatar.types import Camera, HeadParams

FAINTEST_MATTE = 10  # of 255: below it a JPEG matte is noise, not foreground
_MAX_TRACKS = 2**30  # bytes
_LONGEST_SHOWN = 1000  # characters of a path in a sentence


def head_of_matte(matte: np.ndarray) -> np.ndarray:
    """uint8 [H, W], 255 where a matte has anything: as head mask it would count twice in `Frame.composite`."""
    return np.where(matte >= FAINTEST_MATTE, np.uint8(255), np.uint8(0))


class FramePixels(NamedTuple):
    """A frame's images as they come from the files: uint8, at the size that was asked for."""

    image: np.ndarray  # [H, W, 3], red first
    alpha: np.ndarray  # [H, W]
    head_mask: np.ndarray
    mouth_mask: np.ndarray

    @property
    def nbytes(self) -> int:
        return sum(pixels.nbytes for pixels in self)

    def resized(self, size: tuple[int, int]) -> FramePixels:
        """Averaged to `size`, (width, height), so that `Frame.composite` of the result is the average of the composite.

        With w = alpha * head mask of the large pixels and E the mean over a small one: its weight is E[w], its colour
        E[w * image] / E[w]. E[alpha] * E[head mask] would weigh outlines too little, E[image] hold the background.
        """

        def averaged(pixels: np.ndarray) -> np.ndarray:
            return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)

        small = FramePixels(*map(averaged, self))
        weight = self.alpha.astype(np.float32) * self.head_mask
        mean = averaged(weight)
        edge = (mean > 0) & (mean < 255.0**2)
        small.image[edge] = np.rint(averaged(self.image * weight[..., None])[edge] / mean[edge, None])
        masked = small.head_mask > 0
        small.alpha[masked] = np.rint(np.minimum(mean[masked] / small.head_mask[masked], 255.0))
        return small


@dataclass(frozen=True)
class Subject:
    """One person's prepared video. Indices are positions among the usable frames, 0-based."""

    folder: Path  # the prepared subject
    manifest: Manifest
    recording: Recording
    given: Recording | None = None  # with the tracker's own tracks, where they have been refined since

    @classmethod
    def open(cls, prepared: Path | str) -> Subject:
        """Read manifest and tracks, no images. Raises UserError when something is missing, damaged or too old."""
        prepared = Path(prepared)
        manifest = read_manifest(prepared)
        tracks, given = _read_tracks(prepared / TRACKS_FILE, manifest)
        recording = Recording(
            name=manifest.name,
            fps=manifest.fps,
            width=manifest.width,
            height=manifest.height,
            intrinsics=manifest.intrinsics,
            names=tuple(record.name for record in manifest.frames),
            split=Split(manifest.train, manifest.test),
            tracks=tracks,
            data_hash=manifest.data_hash,
            head_fingerprint=manifest.head_fingerprint,
            rig=manifest.rig,
        )
        return cls(prepared, manifest, recording, None if given is None else replace(recording, tracks=given))

    def __len__(self) -> int:
        return len(self.recording)

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def split(self) -> Split:
        return self.recording.split

    @property
    def identity(self) -> Float[Tensor, " S"]:
        """Identity coefficients of the head model."""
        return self.recording.identity

    @property
    def data_hash(self) -> str:
        return self.recording.data_hash

    @property
    def head_fingerprint(self) -> str:
        return self.recording.head_fingerprint

    def as_tracked(self) -> Subject:
        """With what the tracker left, where the tracking has been refined since."""
        return self if self.given is None else replace(self, recording=self.given, given=None)

    def image_size(self, size: int | None = None, index: int | None = None) -> tuple[int, int]:
        """As `Recording.image_size`."""
        return self.recording.image_size(size, index)

    def camera(self, index: int, size: int | None = None) -> Camera:
        """The camera of a frame; it holds the head's pose."""
        return self.recording.camera(index, size)

    def params(self, index: int) -> HeadParams:
        return self.recording.params(index)

    def frame(self, index: int, size: int | None = None) -> Frame:
        """Decode one frame; its width is resized to `size` pixels, the height and the camera follow.

        Raises UserError naming the file when an image is gone or damaged, IndexError for a wrong index.
        """
        return self.assemble(index, self.pixels(index, size), size)

    def pixels(self, index: int, size: int | None = None) -> FramePixels:
        """The frame's images, uint8; what a cache holds. Raises as `frame` does."""
        record = self.manifest.frames[self.recording.checked(index)]
        source = Path(self.manifest.source)
        width, height = self.image_size(index=index)
        shape = (height, width)
        if not os.path.isdir(source):  # noqa: PTH112 (Path.is_dir raises where a name is too long for the system)
            shown = str(source) if len(str(source)) <= _LONGEST_SHOWN else f"...{str(source)[-_LONGEST_SHOWN:]}"
            raise UserError(f"the subject's frames are gone: {shown} does not exist; prepare the subject again")
        image = _same_size(read_image(source / record.image), source / record.image, shape)
        alpha = np.full(shape, 255, np.uint8)
        if record.alpha is not None:
            path = source / record.alpha
            alpha = _same_size(read_matte(path, source / record.image, self.manifest.labels.get("alpha")), path, shape)
        if record.head_mask is None:
            head_mask = head_of_matte(alpha)
        else:
            root = self.folder if self.manifest.head_masks == "derived" else source
            head_mask = self._mask(root, record.head_mask, shape, "head", default=255)
        root = self.folder if self.manifest.mouth_masks == "derived" else source
        mouth_mask = self._mask(root, record.mouth_mask, shape, "mouth", default=0)
        pixels = FramePixels(image, alpha, head_mask, mouth_mask)
        return pixels if size is None or size == width else pixels.resized(self.image_size(size, index))

    def assemble(self, index: int, pixels: FramePixels, size: int | None = None) -> Frame:
        """The frame of pixels that were decoded at `size`."""
        record: FrameRecord = self.manifest.frames[self.recording.checked(index)]
        image, alpha, head_mask, mouth_mask = (torch.from_numpy(p).float() / 255.0 for p in pixels)
        return Frame(
            index=index,
            name=record.name,
            camera=self.camera(index, size),
            params=self.params(index),
            image=image,
            alpha=alpha,
            head_mask=head_mask,
            mouth_mask=mouth_mask,
            shared_time=None if self.recording.rig is None else self.recording.time(index),
        )

    def _mask(self, root: Path, path: str | None, shape: tuple[int, int], kind: str, default: int) -> np.ndarray:
        if path is None:
            return np.full(shape, default, np.uint8)
        return _same_size(read_mask(root / path, self.manifest.labels.get(kind)), root / path, shape)


def _same_size(pixels: np.ndarray, path: Path, shape: tuple[int, int]) -> np.ndarray:
    if pixels.shape[:2] != shape:
        (height, width), (rows, columns) = pixels.shape[:2], shape
        raise UserError(
            f"{path} is {width}x{height} pixels, but the subject was prepared at {columns}x{rows}; prepare it again"
        )
    return pixels


def _read_tracks(file: Path, manifest: Manifest) -> tuple[dict[str, Tensor], dict[str, Tensor] | None]:
    """The tracks, and what they were before their refinement."""
    try:
        tracks = read_tensors(file, _MAX_TRACKS)
    except UserError as error:
        raise UserError(f"{error}; prepare the subject again") from None
    count = len(manifest.frames) if manifest.rig is None else max(manifest.rig.times) + 1
    given = {name.removeprefix(GIVEN): value for name, value in tracks.items() if name.startswith(GIVEN)}
    try:
        return checked_tracks(tracks, count), None if manifest.refinement is None else checked_tracks(given, count)
    except (ValueError, TypeError) as error:
        raise UserError(f"{file} is damaged ({error}); prepare the subject again") from None
