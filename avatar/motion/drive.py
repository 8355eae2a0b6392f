"""Motion that drives an avatar, wherever it comes from: a tracked folder, a drive file, a phone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from avatar.data.subject import Subject
from avatar.head.model import matrix_from_6d, nearest_rotation
from avatar.types import Camera, HeadParams

Whose = Literal["driver", "target"]
SMOOTHING_REACH = 3.0  # standard deviations after which the weights of neighbouring frames end


@dataclass(frozen=True)
class Drive:
    """T frames of one person's motion."""

    name: str
    fps: float
    names: tuple[str, ...]  # of the frames
    params: list[HeadParams]
    cameras: list[Camera] | None  # hold the head's pose; None where it was not recorded
    identity: Float[Tensor, " S"]  # coefficients of the head model; empty where they are not known

    def __len__(self) -> int:
        return len(self.params)


def subject_drive(subject: Subject, size: int | None) -> Drive:
    """All frames of a tracked subject, seen `size` pixels wide; one of each time, where there are several cameras, seen by
    the first of them."""
    frames = all_moments(subject)
    return Drive(
        subject.name,
        subject.recording.fps,
        tuple(subject.recording.names[i] for i in frames),
        [subject.params(i) for i in frames],
        [subject.recording.reference_camera(i, size) for i in frames],
        subject.identity,
    )


def all_moments(subject: Subject) -> tuple[int, ...]:
    """The frames that a drive of the subject is made of."""
    return subject.recording.moments(range(len(subject)))


def smoothed(drive: Drive, sigma: float) -> Drive:
    """Expression, jaw, neck and head pose as Gaussian means over neighbouring frames, `sigma` wide; 0 changes nothing.

    The window is centred, so nothing is delayed. Gaze and eyelids stay as they are: saccades and blinks are quick.
    """
    if sigma == 0.0:
        return drive
    expression = _filtered(torch.stack([p.expression for p in drive.params]), sigma)
    jaw, neck = (
        nearest_rotation(_filtered(matrix_from_6d(torch.stack([getattr(p, joint) for p in drive.params])), sigma))[
            :, :2
        ]
        for joint in ("jaw", "neck")
    )
    params = [
        replace(p, expression=e, jaw=j.reshape(6), neck=n.reshape(6))
        for p, e, j, n in zip(drive.params, expression, jaw, neck, strict=True)
    ]
    cameras = drive.cameras
    if cameras is not None:
        rotations = nearest_rotation(_filtered(torch.stack([c.R_cam_world for c in cameras]), sigma))
        shifts = _filtered(torch.stack([c.t_cam_world for c in cameras]), sigma)
        cameras = [replace(c, R_cam_world=R, t_cam_world=t) for c, R, t in zip(cameras, rotations, shifts, strict=True)]
    return replace(drive, params=params, cameras=cameras)


def _filtered(values: Float[Tensor, "T ..."], sigma: float) -> Float[Tensor, "T ..."]:
    filtered = gaussian_filter1d(values.double().numpy(), sigma, axis=0, mode="nearest", truncate=SMOOTHING_REACH)
    return torch.from_numpy(np.ascontiguousarray(filtered)).to(values)


def choose_cameras(drive: Drive, own: Camera, whose: Whose, intrinsics: Whose) -> list[Camera]:
    """The camera of every frame.

    whose       "driver": the head pose of each driver frame; "target": `own`, the avatar's camera at rest, held still.
                A drive without cameras takes "target".
    intrinsics  of the driver's cameras, "driver": as they are; "target": the avatar's lens, and the head moved along the
                optical axis so that its size in the picture stays: what changes is the perspective
    """
    if whose == "target" or drive.cameras is None:
        return [own] * len(drive)
    if intrinsics == "driver":
        return drive.cameras
    return [_through_lens_of(own, camera) for camera in drive.cameras]


def _through_lens_of(own: Camera, camera: Camera) -> Camera:
    scale = camera.height / own.height
    fx, fy = own.fx * scale, own.fy * scale
    x, y, z = camera.t_cam_world.unbind()
    # The principal point sits where it does in the avatar's pictures; the head stays where it is in the driver's.
    cx, cy = own.cx * camera.width / own.width, own.cy * scale
    depth = z * fy / camera.fy
    shift = torch.stack((x + (camera.cx - cx) * depth / fx, y + (camera.cy - cy) * depth / fy, depth))
    return replace(camera, t_cam_world=shift, fx=fx, fy=fy, cx=cx, cy=cy)
