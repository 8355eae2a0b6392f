"""A person's tracked video without its pictures: what moves, seen by which camera. It goes wherever the avatar goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from avatar.data.split import Split
from avatar.tensors import check_finite, check_shapes
from avatar.types import Camera, HeadParams

TRACK_SHAPES = {
    "expression": "N E",
    "jaw": "N 6",
    "eyes": "N 12",
    "eyelids": "N 2",
    "neck": "N 6",
    "R": "N 3 3",
    "t": "N 3",
    "shape": "S",
}


@dataclass(frozen=True, repr=False)
class Recording:
    """N usable frames of one person. Indices are positions among them, 0-based."""

    name: str
    fps: float
    width: int  # pixels of the video
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels of the video
    names: tuple[str, ...]  # of the frames
    split: Split
    tracks: Mapping[str, Tensor]  # float32, of TRACK_SHAPES
    data_hash: str  # of pictures and tracking
    head_fingerprint: str

    def __repr__(self) -> str:
        return f"<recording of {self.name}: {len(self)} frames of {self.width}x{self.height}, {self.fps:g} a second>"

    def __len__(self) -> int:
        return len(self.names)

    @property
    def identity(self) -> Float[Tensor, " S"]:
        """Identity coefficients of the head model."""
        return self.tracks["shape"]

    def image_size(self, size: int | None = None) -> tuple[int, int]:
        """(width, height) of the frames when the width is resized to `size` pixels; None keeps the video's size."""
        if size is None:
            return self.width, self.height
        if size < 1:
            raise ValueError(f"size must be at least 1 pixel, got {size}")
        if size != int(size):
            raise ValueError(f"size must be a whole number of pixels, got {size}")
        return size, max(1, round(size * self.height / self.width))

    def camera(self, index: int, size: int | None = None) -> Camera:
        """The camera of a frame; it holds the head's pose."""
        index = self.checked(index)
        fx, fy, cx, cy = self.intrinsics
        camera = Camera(self.tracks["R"][index], self.tracks["t"][index], fx, fy, cx, cy, self.width, self.height)
        return camera if size is None else camera.resized(*self.image_size(size))

    def params(self, index: int) -> HeadParams:
        index = self.checked(index)
        return HeadParams(**{name: self.tracks[name][index] for name in HeadParams.__dataclass_fields__})

    def motion(self, indices: Sequence[int]) -> list[HeadParams]:
        return [self.params(index) for index in indices]

    def checked(self, index: int) -> int:
        """`index`, if there is such a frame; IndexError otherwise."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of subject {self.name}, which has frames 0 to {len(self) - 1}")
        return index


def checked_tracks(tracks: Mapping[str, Tensor], count: int) -> dict[str, Tensor]:
    """The tracks of `count` frames as float32. Raises ValueError or TypeError naming what is missing or wrong."""
    missing = TRACK_SHAPES.keys() - tracks.keys()
    if missing:
        raise ValueError(f"it lacks {', '.join(sorted(missing))}")
    sizes = check_shapes(**{name: (tracks[name], shape) for name, shape in TRACK_SHAPES.items()})
    check_finite(**{name: tracks[name] for name in TRACK_SHAPES})
    if sizes["N"] != count:
        raise ValueError(f"it has {sizes['N']} frames where {count} are listed")
    return {name: tracks[name].float() for name in TRACK_SHAPES}
