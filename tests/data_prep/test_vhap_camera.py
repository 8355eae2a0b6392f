"""VHAP's camera, written from its conventions alone.

`transform_matrix` is the camera in the world with OpenGL's axes, and its listings count `cy` from the bottom.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tracked_folder import rotation, write_head_model

from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.prepare.prepare import prepare

WIDTH, HEIGHT = 80, 64
FX, FY = 200.0, 210.0
CX_FROM_LEFT, CY_FROM_BOTTOM = 33.0, 41.0
CAMERA_IN_WORLD = np.eye(4)  # OpenGL's axes: x right, y up, looks along -z
CAMERA_IN_WORLD[:3, :3] = rotation(0.1, -0.15, 0.05)
CAMERA_IN_WORLD[:3, 3] = CAMERA_IN_WORLD[:3, :3] @ (0.01, 0.02, 0.9)
FRAMES = 6


def write_folder(folder: Path, own_intrinsics: bool) -> Path:
    """Heads at rest, without global rotation, that move aside; pictures of nothing."""
    for name in ("images", "flame_param"):
        (folder / name).mkdir(parents=True)
    camera = {"fl_x": FX, "fl_y": FY, "cx": CX_FROM_LEFT, "cy": CY_FROM_BOTTOM, "w": WIDTH, "h": HEIGHT}
    frames = []
    for n in range(FRAMES):
        noise = np.random.default_rng(n).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        assert cv2.imwrite(str(folder / "images" / f"{n:05d}_00.png"), noise)
        joints = {"rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "expr": 100}
        values = {name: np.zeros((1, count), np.float32) for name, count in joints.items()}
        translation = np.array([[0.004 * n, 0.0, 0.0]], np.float32)
        np.savez(
            folder / "flame_param" / f"{n:05d}.npz", translation=translation, shape=np.zeros(300, np.float32), **values
        )
        frame = {
            "file_path": f"images/{n:05d}_00.png",
            "flame_param_path": f"flame_param/{n:05d}.npz",
            "transform_matrix": CAMERA_IN_WORLD.tolist(),
        }
        frames.append(frame | (camera if own_intrinsics else {}))
    listing = {"frames": frames} | ({} if own_intrinsics else camera)
    (folder / "transforms.json").write_text(json.dumps(listing))
    return folder


def expected_pixels(vertices: np.ndarray, number: int) -> np.ndarray:
    """OpenGL's way: y up in the camera and in the picture; then counted from the top."""
    R, t = CAMERA_IN_WORLD[:3, :3], CAMERA_IN_WORLD[:3, 3]
    moved = vertices + np.array([0.004 * number, 0.0, 0.0])
    x, y, z = R.T @ (moved - t).T
    from_bottom = CY_FROM_BOTTOM + FY * y / -z
    return np.stack((CX_FROM_LEFT + FX * x / -z, HEIGHT - from_bottom), axis=1)


@pytest.mark.parametrize("own_intrinsics", [False, True])
def test_the_principal_point_is_counted_from_the_bottom(own_intrinsics: bool, tmp_path: Path) -> None:
    write_head_model(tmp_path / "head")
    head = load_head_assets(tmp_path / "head")
    folder = write_folder(tmp_path / "vhap", own_intrinsics)
    source = Source(folder, tmp_path / "head", ignore_misfit=True)
    subject = Subject.open(prepare(source, head, out=tmp_path / "out", say=lambda _: None))
    assert subject.camera(0).cy == HEIGHT - CY_FROM_BOTTOM
    model = HeadModel(head, torch.zeros(300))
    for number in (0, FRAMES - 1):
        vertices = model.vertices(subject.params(number))
        seen = subject.camera(number).project(vertices)[:, :2].numpy()
        np.testing.assert_allclose(seen, expected_pixels(vertices.double().numpy(), number), atol=1e-2)
