"""The demo's rig as it was filmed: NeRSemble's layout of a sequence, and GaussianHeadAvatar's, written from their facts.

Both are made of a folder in VHAP's layout that holds the truth, in a world that is turned and in another unit.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from videos import encode

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
TURN = cv2.Rodrigues(np.array([0.3, -0.8, 0.2]))[0]
Entry = dict[str, Any]


def entries(truth: Path) -> list[Entry]:
    return json.loads((truth / "transforms.json").read_text())["frames"]


def serial(entry: Entry) -> str:
    return serial_of(entry["camera_id"])


def serial_of(camera: str) -> str:
    """cam_03 -> 222200003"""
    return f"2222000{camera[-2:]}"


def world_to_camera(entry: Entry, unit: float) -> np.ndarray:
    """[4, 4] in a world that is turned and moved, of whose units a metre has 1 / `unit`."""
    to_truth = np.linalg.inv(np.array(entry["transform_matrix"]) @ OPENGL)
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = TURN, (0.4, -0.2, 1.0)
    matrix = to_truth @ moved
    matrix[:3, 3] /= unit
    return matrix


def lens(entry: Entry) -> np.ndarray:
    return np.array(
        [[entry["fl_x"], 0, entry["cx"]], [0, entry["fl_y"], entry["h"] - entry["cy"]], [0, 0, 1]]  # cy from the bottom
    )


def tinted(picture: np.ndarray, undo: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The sRGB picture before its linear colours [H, W, 3] were corrected by what `undo` inverts."""
    encoded = picture / 255
    before = undo(np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4))
    assert before.min() >= 0 and before.max() <= 1
    encoded = np.where(before <= 0.0031308, 12.92 * before, 1.055 * before ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)


def write_raw(truth: Path, root: Path, unit: float, times: int | None = None, fps: float = 25.0) -> Path:
    """ROOT/person/sequences/SPEECH, each camera darker than the one before, and the calibration above it."""
    sequence = root / "person" / "sequences" / truth.name
    (sequence / "images").mkdir(parents=True)
    listed = entries(truth)
    own = {serial(entry): entry for entry in listed}
    gains = {name: 1 + 0.15 * index for index, name in enumerate(own)}
    for name in own:
        files = [truth / entry["file_path"] for entry in listed if serial(entry) == name][:times]
        pictures = [tinted(cv2.imread(str(file))[..., ::-1], lambda x, gain=gains[name]: x / gain) for file in files]
        encode(sequence / "images" / f"cam_{name}.mp4", pictures, fps)
    (root / "person" / "calibration").mkdir()
    calibration = {
        "world_2_cam": {name: world_to_camera(entry, unit).tolist() for name, entry in own.items()},
        "intrinsics": {name: lens(entry).tolist() for name, entry in own.items()},
    }
    (root / "person" / "calibration" / "camera_params.json").write_text(json.dumps(calibration))
    matrices = {name: (gain * np.eye(3)).tolist() for name, gain in gains.items()}
    (root / "person" / "calibration" / "color_calibration.json").write_text(json.dumps(matrices))
    return sequence


def write_gha(truth: Path, folder: Path, unit: float, times: int | None = None) -> Path:
    for entry in entries(truth):
        time = entry["timestep_index"]
        if times is not None and time >= times:
            continue
        for kind in ("images", "cameras"):
            (folder / kind / f"{time:04d}").mkdir(parents=True, exist_ok=True)
        for kind, path in (("image", "file_path"), ("mask", "fg_mask_path")):
            picture = cv2.imread(str(truth / entry[path]))
            options = [cv2.IMWRITE_JPEG_QUALITY, 95]
            cv2.imwrite(str(folder / "images" / f"{time:04d}" / f"{kind}_{serial(entry)}.jpg"), picture, options)
        pose = world_to_camera(entry, unit)[:3]
        np.savez(
            folder / "cameras" / f"{time:04d}" / f"camera_{serial(entry)}.npz", extrinsic=pose, intrinsic=lens(entry)
        )
    return folder


class Filmed(NamedTuple):
    pose: np.ndarray  # [4, 4] world to camera
    K: np.ndarray
    greys: list[int]  # of its pictures


def _filmed(index: int) -> Filmed:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.array([0.1, 0.3 * index, 0.0]))[0], (0.1 * index, 0.2, 1.0)
    K = np.array([[150.0 + index, 0, 30], [0, 151.0, 34], [0, 0, 1]])
    return Filmed(pose, K, [40 * n + 10 * index + 30 for n in range(4)])


FILMED = {name: _filmed(index) for index, name in enumerate(("220700191", "222200037", "222200046"))}
"""Cameras whose pictures are of one grey each."""


def _plain(grey: int) -> np.ndarray:
    return np.full((64, 64, 3), grey, np.uint8)


def write_plain_raw(root: Path, frames: int = 4) -> Path:
    sequence = root / "person" / "sequences" / "EXP-1"
    (sequence / "images").mkdir(parents=True)
    for name, one in FILMED.items():
        encode(sequence / "images" / f"cam_{name}.mp4", [_plain(grey) for grey in one.greys[:frames]])
    (root / "person" / "calibration").mkdir()
    calibration = {
        "world_2_cam": {name: one.pose.tolist() for name, one in FILMED.items()},
        "intrinsics": {name: one.K.tolist() for name, one in FILMED.items()},
    }
    (root / "person" / "calibration" / "camera_params.json").write_text(json.dumps(calibration))
    return sequence


def write_plain_gha(folder: Path) -> Path:
    for time in range(4):
        images, cameras = (folder / kind / f"{time:04d}" for kind in ("images", "cameras"))
        images.mkdir(parents=True)
        cameras.mkdir(parents=True)
        for name, one in FILMED.items():
            assert cv2.imwrite(str(images / f"image_{name}.jpg"), _plain(one.greys[time]))
            assert cv2.imwrite(str(images / f"image_lowres_{name}.jpg"), _plain(0))
            assert cv2.imwrite(str(images / f"mask_{name}.jpg"), _plain(255))
            np.savez(cameras / f"camera_{name}.npz", extrinsic=one.pose[:3], intrinsic=one.K)
    return folder
