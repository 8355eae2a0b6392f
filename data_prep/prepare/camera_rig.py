"""The cameras of a rig and the head before them, out of the head's pose before each camera at each time.

A frame's tracking holds how its camera sees the head: p_cam = R p_head + t. Cameras that stand still differ by one rigid
motion at all times, so each has one pose from the reference camera, and the head has one pose at each time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from avatar.data.camera_rig import CameraRig, RigCamera
from avatar.errors import UserError
from data_prep.formats.frame_track import FrameTrack
from data_prep.formats.tracked_folder import Shot

MOVED_DEGREES, MOVED_METRES = 0.5, 0.002  # of a camera against the reference, from which the rig is not one
_SHOWN_DIGITS = 10  # of a camera's pose; rounding noise below would change the bytes from machine to machine


class Pose(NamedTuple):
    """p_to = R p_from + t."""

    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, " 3"]  # metres

    def after(self, other: Pose) -> Pose:
        return Pose(self.R @ other.R, self.R @ other.t + self.t)

    def inverse(self) -> Pose:
        return Pose(self.R.T, -self.R.T @ self.t)


class FoundCameras(NamedTuple):
    rig: CameraRig
    rows: tuple[FrameTrack, ...]  # one frame of each time
    heads: tuple[Pose, ...]  # of the head before the reference camera, at each time


def find_rig(shots: Sequence[Shot], tracks: Sequence[FrameTrack]) -> FoundCameras:
    """The rig of pictures in the order of time; the reference is the camera that sees the face most from the front.

    Raises UserError for a camera that moves, and for one that shares no time with the others.
    """
    names = _by_frontality(shots, tracks)
    of_camera: dict[str, dict[int, Pose]] = {name: {} for name in names}
    of_time: dict[int, FrameTrack] = {}
    for shot, track in zip(shots, tracks, strict=True):
        of_camera[shot.camera][shot.time] = Pose(track.R, track.t)
        of_time.setdefault(shot.time, track)
    heads = dict(of_camera[names[0]])
    cameras = {names[0]: Pose(np.eye(3), np.zeros(3))}
    while len(cameras) < len(names):
        waiting = [name for name in names if name not in cameras]
        placed = next((name for name in waiting if of_camera[name].keys() & heads.keys()), None)
        if placed is None:
            raise UserError(
                f"camera {waiting[0]} has no picture of a time that camera {names[0]} has one of, so that where it stands "
                "is not known; leave it out with --cameras"
            )
        cameras[placed] = _common_pose(placed, names[0], of_camera[placed], heads)
        for time, pose in of_camera[placed].items():
            heads.setdefault(time, cameras[placed].inverse().after(pose))
    times = {time: row for row, time in enumerate(sorted(of_time))}
    lenses = {shot.camera: track for shot, track in zip(reversed(shots), reversed(tracks), strict=True)}
    rig = CameraRig(
        tuple(_camera(name, lenses[name], cameras[name]) for name in names),
        tuple(times[shot.time] for shot in shots),
        tuple(names.index(shot.camera) for shot in shots),
    )
    return FoundCameras(rig, tuple(of_time[time] for time in times), tuple(heads[time] for time in times))


def heads_before(rig: CameraRig, tracks: Sequence[FrameTrack]) -> tuple[list[FrameTrack], list[Pose]]:
    """One frame of each time, and the head before the reference camera, as this rig's pictures have it."""
    pictures = rig.moments(range(len(tracks)))
    cameras = [rig.cameras[rig.views[picture]] for picture in pictures]
    poses = [Pose(np.array(camera.R).reshape(3, 3), np.array(camera.t)) for camera in cameras]
    rows = [tracks[picture] for picture in pictures]
    return rows, [pose.inverse().after(Pose(row.R, row.t)) for pose, row in zip(poses, rows, strict=True)]


def _by_frontality(shots: Sequence[Shot], tracks: Sequence[FrameTrack]) -> list[str]:
    """The cameras' names: the most frontal first, the others as they come."""
    facing: dict[str, list[float]] = {}
    for shot, track in zip(shots, tracks, strict=True):
        facing.setdefault(shot.camera, []).append(-float(track.R[2, 2]))
    front = max(facing, key=lambda name: float(np.mean(facing[name])))
    return [front, *(name for name in facing if name != front)]


def _common_pose(name: str, reference: str, poses: Mapping[int, Pose], heads: Mapping[int, Pose]) -> Pose:
    """Where a camera stands, from the times at which the head's pose is known."""
    found = [poses[time].after(heads[time].inverse()) for time in sorted(poses.keys() & heads.keys())]
    U, _, Vt = np.linalg.svd(np.mean([pose.R for pose in found], axis=0))
    mean = Pose(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, np.median([pose.t for pose in found], axis=0))
    cosines = [(np.trace(mean.R.T @ pose.R) - 1) / 2 for pose in found]
    turned = float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())
    shifted = max(float(np.linalg.norm(mean.inverse().t - pose.inverse().t)) for pose in found)
    if turned > MOVED_DEGREES or shifted > MOVED_METRES:
        raise UserError(
            f"camera {name} moves against camera {reference}, by up to {turned:.2g} degrees and {1e3 * shifted:.2g} mm; "
            "cameras have to stand still within a recording: calibrate it again, or leave it out with --cameras"
        )
    return mean


def _camera(name: str, track: FrameTrack, pose: Pose) -> RigCamera:
    fx, fy, cx, cy = track.intrinsics.tolist()
    R, t = (tuple(np.round(values, _SHOWN_DIGITS).ravel().tolist()) for values in pose)
    return RigCamera(name, *track.size, (fx, fy, cx, cy), R, t)
