"""Several cameras that film one person at the same times, and which picture is of which camera and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.json_values import parse_object
from avatar.types import Camera

MOST_CAMERAS = 1000
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class RigCamera:
    """One camera of a rig: its lens, and where it stands from the reference camera.

    p_cam = R p_ref + t for a point in the axes of the reference camera, metres.
    """

    name: str
    width: int  # pixels
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels
    R: tuple[float, ...] = _IDENTITY  # row by row
    t: tuple[float, ...] = (0.0, 0.0, 0.0)  # metres

    def image_size(self, size: int | None = None) -> tuple[int, int]:
        """(width, height) when the width is resized to `size` pixels; None keeps the files' size."""
        if size is None:
            return self.width, self.height
        if size < 1:
            raise ValueError(f"size must be at least 1 pixel, got {size}")
        if size != int(size):
            raise ValueError(f"size must be a whole number of pixels, got {size}")
        return size, max(1, round(size * self.height / self.width))

    def sees(self, R_ref_world: Float[Tensor, "3 3"], t_ref_world: Float[Tensor, " 3"]) -> Camera:
        """The camera of a head that the reference camera sees in this pose; computed in float64."""
        R = torch.tensor(self.R, dtype=torch.float64).reshape(3, 3)
        return Camera(
            (R @ R_ref_world.double()).to(R_ref_world),
            (R @ t_ref_world.double() + torch.tensor(self.t, dtype=torch.float64)).to(t_ref_world),
            *self.intrinsics,
            self.width,
            self.height,
            R_ref_cam=R.T.contiguous().to(R_ref_world),
        )


@dataclass(frozen=True)
class CameraRig:
    """The first camera is the reference: the R and t of a recording's tracks are the head's pose before it."""

    cameras: tuple[RigCamera, ...]
    times: tuple[int, ...]  # of each picture: its row of the tracks
    views: tuple[int, ...]  # of each picture: its camera

    def moments(self, pictures: Sequence[int]) -> tuple[int, ...]:
        """One picture of each time that these pictures are of, in the order of time: by the first camera that there is."""
        of_time: dict[int, int] = {}
        for picture in sorted(pictures, key=lambda i: (self.times[i], self.views[i])):
            of_time.setdefault(self.times[picture], picture)
        return tuple(of_time.values())

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def parse_rig(raw: Any, pictures: int) -> CameraRig:
    """What `CameraRig.to_dict` gave, read from JSON, for so many pictures. Raises KeyError, TypeError or ValueError."""
    cameras = raw["cameras"]
    if not isinstance(cameras, list) or not 1 <= len(cameras) <= MOST_CAMERAS:
        raise ValueError(f"cameras is not a list of 1 to {MOST_CAMERAS} cameras")
    rig = CameraRig(
        tuple(_parse_camera(one) for one in cameras),
        _positions(raw["times"], "times", pictures, pictures),
        _positions(raw["views"], "views", pictures, len(cameras)),
    )
    if set(rig.times) != set(range(max(rig.times) + 1)):
        raise ValueError("a time has no picture")
    return rig


def _parse_camera(raw: Any) -> RigCamera:
    camera = parse_object(raw, RigCamera, "a camera")
    if not all(1 <= side < 2**16 for side in (camera.width, camera.height)):
        raise ValueError(f"a camera's image size of {camera.width}x{camera.height} is impossible")
    if min(camera.intrinsics[:2]) <= 0:
        raise ValueError("a camera's focal length is not positive")
    if len(camera.R) != 9 or len(camera.t) != 3:
        raise ValueError("a camera's pose is not 9 and 3 numbers")
    R = torch.tensor(camera.R, dtype=torch.float64).reshape(3, 3)
    if not torch.allclose(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-4) or torch.det(R) < 0:
        raise ValueError("a camera's R is not a rotation")
    return camera


def _positions(values: Any, key: str, count: int, stop: int) -> tuple[int, ...]:
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{key} is not a list of {count} numbers")
    if not all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v < stop for v in values):
        raise ValueError(f"{key} holds something else than numbers from 0 to {stop - 1}")
    return tuple(values)
