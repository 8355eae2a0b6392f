"""The demo person's cameras and head as the files of the layout say, by the facts about it and by no importer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.head.rasterize import rasterize_mesh
from avatar.types import HeadParams

CAMERAS, FRONT, FRAMES, SIZE, SEED = 3, 1, 2, 64, 3  # a person without glasses
NAMES = ("SPEECH", "GAZE", "FREE")
NAMES = ("SPEECH", "GAZE", "FREE")


def listing(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8"))


class View(NamedTuple):
    """One entry of a listing, read by the facts of the layout: OpenCV camera, and FLAME's root pose."""

    R: np.ndarray  # world to camera
    t: np.ndarray
    K: np.ndarray
    R_root: np.ndarray
    translation: np.ndarray
    flame: dict[str, np.ndarray]
    matte: np.ndarray

    def of_head(self, joint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From the head's space to the camera."""
        return self.R @ self.R_root, self.R @ (joint - self.R_root @ joint + self.translation) + self.t


def view(sequence: Path, entry: dict[str, Any]) -> View:
    c2w = np.array(entry["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    K = np.array([[entry["fl_x"], 0, entry["cx"]], [0, entry["fl_y"], entry["h"] - entry["cy"]], [0, 0, 1]])
    with np.load(sequence / entry["flame_param_path"]) as file:
        flame = dict(file)
    matte = cv2.imread(str(sequence / entry["fg_mask_path"]), cv2.IMREAD_UNCHANGED)
    assert matte is not None
    R = c2w[:3, :3].T
    root = cv2.Rodrigues(flame["rotation"][0].astype(float))[0]
    return View(R, -R @ c2w[:3, 3], K, root, flame["translation"][0].astype(float), flame, matte)


def posed(assets: HeadAssets, flame: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(vertices [V, 3], root joint [3]) of a parameter file, in the head's space."""

    def six(axis_angles: np.ndarray) -> torch.Tensor:
        rows = [cv2.Rodrigues(a.astype(float))[0][:2].reshape(-1) for a in axis_angles.reshape(-1, 3)]
        return torch.tensor(np.concatenate(rows), dtype=torch.float32)

    params = HeadParams(
        expression=torch.from_numpy(flame["expr"][0]),
        jaw=six(flame["jaw_pose"]),
        eyes=six(flame["eyes_pose"]),
        eyelids=torch.zeros(2),
        neck=six(flame["neck_pose"]),
    )
    shape, expression = torch.from_numpy(flame["shape"]), params.expression
    unposed = assets.template + assets.shape_dirs @ shape + assets.expression_dirs @ expression
    return HeadModel(assets, shape).vertices(params).numpy(), (assets.joint_regressor[0] @ unposed).numpy()


def drawn(assets: HeadAssets, seen: View) -> np.ndarray:
    """Where the head model is in the picture, bool [H, W]."""
    vertices, joint = posed(assets, seen.flame)
    R, t = seen.of_head(joint)
    p = vertices @ R.T + t
    screen = np.column_stack((p[:, :2] / p[:, 2:] * seen.K[[0, 1], [0, 1]] + seen.K[:2, 2], p[:, 2]))
    return rasterize_mesh(screen, assets.faces.numpy(), SIZE, SIZE).face_id >= 0


def views(folder: Path, name: str) -> list[tuple[dict[str, Any], View]]:
    entries = listing(folder / name / "transforms.json")["frames"]
    return [(entry, view(folder / name, entry)) for entry in entries]
