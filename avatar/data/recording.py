"""A person's tracked video without its pictures: what moves, seen by which camera. It goes wherever the avatar goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from avatar.data.camera_rig import CameraRig, RigCamera
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
    """The usable frames of one person, pictures of one camera or of several. Indices are positions among them, 0-based."""

    name: str
    fps: float
    width: int  # pixels of the video
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels of the video
    names: tuple[str, ...]  # of the frames
    split: Split
    tracks: Mapping[str, Tensor]  # float32, of TRACK_SHAPES; a row for each frame, with a rig for each time
    data_hash: str  # of pictures and tracking
    head_fingerprint: str
    rig: CameraRig | None = None  # of several cameras; size and intrinsics above are of its first one

    def __repr__(self) -> str:
        return f"<recording of {self.name}: {len(self)} frames of {self.width}x{self.height}, {self.fps:g} a second>"

    def __len__(self) -> int:
        return len(self.names)

    @property
    def identity(self) -> Float[Tensor, " S"]:
        """Identity coefficients of the head model."""
        return self.tracks["shape"]

    @property
    def cameras(self) -> tuple[RigCamera, ...]:
        """Every camera; the first is the one before which the tracks place the head."""
        if self.rig is not None:
            return self.rig.cameras
        return (RigCamera("camera", self.width, self.height, self.intrinsics),)

    def time(self, index: int) -> int:
        """The row of the tracks that a frame is of."""
        index = self.checked(index)
        return index if self.rig is None else self.rig.times[index]

    def view(self, index: int) -> int:
        """Which of the cameras filmed a frame."""
        index = self.checked(index)
        return 0 if self.rig is None else self.rig.views[index]

    def moments(self, indices: Sequence[int]) -> tuple[int, ...]:
        """One frame of each time that these are of, in the order of time: by the first camera that there is. With one
        camera the frames as they are."""
        return tuple(indices) if self.rig is None else self.rig.moments(indices)

    def image_size(self, size: int | None = None, index: int | None = None) -> tuple[int, int]:
        """(width, height) when the width is resized to `size` pixels; None keeps the files' size.

        index  of the frame; None: the largest of the cameras' sizes
        """
        if index is not None:
            return self.cameras[self.view(index)].image_size(size)
        return max((one.image_size(size) for one in self.cameras), key=lambda both: both[0] * both[1])

    def smallest_size(self, size: int | None = None) -> tuple[int, int]:
        """`image_size` of the camera whose shorter side is the least."""
        return min((one.image_size(size) for one in self.cameras), key=min)

    def camera(self, index: int, size: int | None = None, view: int | None = None) -> Camera:
        """The camera of a frame; it holds the head's pose.

        view  which camera, whether it filmed the frame or not; None: the one that did
        """
        row, view = self.time(index), self.view(index) if view is None else view
        R, t = self.tracks["R"][row], self.tracks["t"][row]
        if self.rig is None:
            camera = Camera(R, t, *self.intrinsics, width=self.width, height=self.height)
        else:
            camera = self.rig.cameras[view].sees(R, t)
        return camera if size is None else camera.resized(*self.cameras[view].image_size(size))

    def reference_camera(self, index: int, size: int | None = None) -> Camera:
        """The first camera at a frame's time, whether it filmed the frame or not."""
        return self.camera(index, size, 0)

    def params(self, index: int) -> HeadParams:
        row = self.time(index)
        return HeadParams(**{name: self.tracks[name][row] for name in HeadParams.__dataclass_fields__})

    def motion(self, indices: Sequence[int]) -> list[HeadParams]:
        """The head's parameters at each of the frames' `moments`."""
        return [self.params(index) for index in self.moments(indices)]

    def times(self, indices: Sequence[int]) -> list[int]:
        """The rows of the tracks of the frames' `moments`."""
        return [self.time(index) for index in self.moments(indices)]

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
