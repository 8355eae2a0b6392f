"""The tracking of a rig as VHAP's export, which `data_prep.formats.vhap` reads; `eyelids` [2] are added to its parameters.

The cameras' world is the calibration's, scaled to metres.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from avatar.head.assets import HeadAssets
from avatar.head.model import NECK, ROOT, matrix_from_6d
from data_prep.formats.frame_track import FrameTrack
from data_prep.formats.root_pose import Joint
from data_prep.formats.transforms import OPENCV_FROM_OPENGL
from data_prep.prepare.camera_rig import Pose
from data_prep.track.camera_rig.recording import Camera
from data_prep.track.footage.source import View
from data_prep.track.frames import frame_file, mask_file

IMAGES, MATTES, PARAMETERS, LISTING = "images", "fg_masks", "flame_param", "transforms.json"
TRAIN_LISTING, TEST_LISTING = "transforms_train.json", "transforms_test.json"


def lens_in(camera: Camera, view: View) -> np.ndarray:
    """fx, fy, cx, cy in pixels of a view of the whole pictures."""
    across, down = view.width / camera.footage.width, view.height / camera.footage.height
    return camera.intrinsics * np.array([across, down, across, down])


def write_listing(
    folder: Path,
    cameras: Mapping[str, Camera],
    views: Mapping[str, View],
    times: Sequence[int],
    scale: float,
    fps: float,
    tested: Collection[int] = (),
) -> None:
    """`scale` is in metres for one unit of the calibration; times of `tested` are listed by themselves."""
    trained = [time for time in times if time not in tested]
    listings = {TRAIN_LISTING: trained, TEST_LISTING: sorted(tested)} if tested else {LISTING: trained}
    for name, own in listings.items():
        entries = list(_entries(cameras, views, own, scale))
        content = {"frames": entries, "fps": fps, "timestep_indices": own, "camera_indices": [*range(len(cameras))]}
        (folder / name).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _entries(
    cameras: Mapping[str, Camera], views: Mapping[str, View], times: Sequence[int], scale: float
) -> Iterator[dict[str, Any]]:
    for time in times:
        for index, (serial, camera) in enumerate(cameras.items()):
            fx, fy, cx, cy = lens_in(camera, views[serial]).tolist()
            width, height = views[serial].width, views[serial].height
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = camera.R.T @ OPENCV_FROM_OPENGL, -scale * camera.R.T @ camera.t
            yield {
                "timestep_index": time,
                "camera_index": index,
                "camera_id": serial,
                "fl_x": fx,
                "fl_y": fy,
                "cx": cx,
                "cy": height - cy,
                "w": width,
                "h": height,  # cy from the bottom
                "transform_matrix": matrix.tolist(),
                "file_path": frame_file(Path(IMAGES, serial), time).as_posix(),
                "fg_mask_path": mask_file(Path(MATTES, serial), time).as_posix(),
                "flame_param_path": f"{PARAMETERS}/{time:05d}.npz",
            }


def write_parameters(folder: Path, tracks: Mapping[int, FrameTrack], to_world: Pose, head: HeadAssets) -> None:
    """One file for each time; `to_world` is from the camera's axes that the tracks' R and t lead to."""
    root, neck = Joint(head, ROOT), Joint(head, NECK)
    (folder / PARAMETERS).mkdir(parents=True)
    for time, track in tracks.items():
        joint, pivot = root.position(track.shape, track.expression), neck.position(track.shape)
        N = _matrices(track.neck)[0]
        R = track.R @ N.T  # the torso's, which the neck turns the head against (`root_pose.turned_with_neck`)
        torso = to_world.after(Pose(R, track.t - R @ (pivot - N @ pivot)))
        arrays = {
            "translation": (torso.t - joint + torso.R @ joint)[None],
            "rotation": _axis_angles(torso.R[None])[None],
            "neck_pose": _axis_angles(N[None])[None],
            "jaw_pose": _axis_angles(_matrices(track.jaw))[None],
            "eyes_pose": _axis_angles(_matrices(track.eyes))[None],
            "eyelids": track.eyelids[None],
            "expr": track.expression[None],
            "shape": track.shape,
        }
        values: dict[str, Any] = {name: array.astype(np.float32) for name, array in arrays.items()}
        np.savez(folder / PARAMETERS / f"{time:05d}.npz", **values)


def _matrices(six_d: np.ndarray) -> np.ndarray:
    """[K, 3, 3] of K rotations in six values each."""
    return matrix_from_6d(torch.from_numpy(six_d.reshape(-1, 6))).numpy()


def _axis_angles(rotations: np.ndarray) -> np.ndarray:
    return np.concatenate([cv2.Rodrigues(R)[0].ravel() for R in rotations])
