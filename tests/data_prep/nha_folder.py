"""One person of NHA's data set, written from the facts of that layout; the head is posed here by FLAME's own formulas.

    frame_%04d/{image,seg,parsing}_0000.png, split.json, tracked_flame_params_0.npz

A vertex of FLAME without a global turn is at R (v - J0) + translation, x to the left, y up, z forward.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from tracked_folder import COLUMNS, SHAPE_COEFFICIENTS, motion, rotation, write_head_model

from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.rasterize import rasterize_mesh

FRAMES, SIZE = 24, (64, 56)  # width, height
FOCAL, CX, CY_FROM_BOTTOM = 2.4, 0.47, 0.56  # of the longer side, the width, the height
NECK = np.radians([88.0, -58.0, 78.0])  # near the limits, degrees: ±90, ±60, ±80; jaw -5..60; eyes ±50
JAW = np.radians([58.0, 0.09, -0.09])
EYES = np.radians([48.0, -48.0, 0.09, -48.0, 48.0, -0.09])
DEGREES = {
    "neck_pose": [(-90, 90), (-60, 60), (-80, 80)],
    "jaw_pose": [(-5, 60), (-0.1, 0.1), (-0.1, 0.1)],
    "eyes_pose": [(-50, 50), (-50, 50), (-0.1, 0.1)] * 2,
}
SKIN, LIP, CLOTH = 1, 12, 16  # of BiSeNet
HEAD, BODY = 101, 100  # labels of seg_0000.png
Edit = Callable[[dict[str, np.ndarray]], object]


def write_head(directory: Path) -> HeadAssets:
    """With a torso, the last rings, and a neck joint that is neither the root nor moved by expressions."""
    write_head_model(directory)
    file = directory / "generic_model.pkl"
    model = pickle.loads(file.read_bytes())
    model["weights"][-3 * COLUMNS :] = np.float32([0.8, 0.2, 0, 0, 0])
    ring = np.arange(COLUMNS) - 5 * COLUMNS
    model["J_regressor"][1] = 0
    model["J_regressor"][1, ring[model["v_template"][ring, 2] < 0]] = 1
    model["J_regressor"][1] /= model["J_regressor"][1].sum()
    file.write_bytes(pickle.dumps(model, protocol=2))
    return load_head_assets(directory)


def turn(vector: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(np.asarray(vector, np.float64))[0]


def true_rows(frames: int) -> list[dict[str, np.ndarray]]:
    """Angles in radians. The head looks at the camera whatever its neck does; the first three are near the limits."""
    rows = []
    for number, track in enumerate(motion(frames, 10, 2)):
        wave = np.sin(1.3 * number + np.arange(6))
        row = {
            "neck_pose": 0.4 * wave[:3],
            "jaw_pose": JAW * [0.2 * wave[0] ** 2, 1, 1],
            "eyes_pose": EYES * 0.3 * wave,
        }
        row |= (
            [{"neck_pose": NECK * [1, 0, 0]}, {"neck_pose": NECK * [0, 1, 0], "eyes_pose": EYES}, {"jaw_pose": JAW}][
                number
            ]
            if number < 3
            else {}
        )
        row["neck_pose"] = NECK * [0, 0, 1] if number == 3 else row["neck_pose"]
        facing = rotation(0.1 * wave[3], np.pi + 0.1 * wave[4], 0.1 * wave[5])  # x left, z forward: it looks back
        row["rotation"] = cv2.Rodrigues(facing @ turn(row["neck_pose"]).T)[0].ravel()
        row["translation"] = np.array([0.01, -0.05, 0.85]) + 0.01 * wave[:3]
        row["expr"] = np.pad(track["expression"], (0, 90))
        rows.append(row)
    return rows


def posed(head: HeadAssets, identity: np.ndarray, row: dict[str, np.ndarray]) -> np.ndarray:
    """[V, 3] in OpenCV's axes: FLAME's joints one after the other, then the global turn about the root joint."""
    directions = np.concatenate((head.shape_dirs.numpy(), head.expression_dirs.numpy()), axis=2).astype(np.float64)
    known = np.concatenate((identity, row["expr"][: head.num_expressions]))
    shape = head.template.double().numpy() + directions @ known
    J = head.joint_regressor.double().numpy() @ shape
    turns = [np.eye(3), *(turn(v) for v in np.concatenate([row[n] for n in DEGREES]).reshape(-1, 3))]
    to_world = [(np.eye(3), np.zeros(3))]
    for joint, parent in ((1, 0), (2, 1), (3, 1), (4, 1)):
        R, t = to_world[parent]
        to_world.append((R @ turns[joint], R @ (J[joint] - turns[joint] @ J[joint]) + t))
    weights = head.weights.double().numpy()
    vertices = sum(weights[:, j, None] * (shape @ R.T + t) for j, (R, t) in enumerate(to_world))
    return ((vertices - J[0]) @ turn(row["rotation"]).T + row["translation"]) * [-1, -1, 1]


def true_screen(
    head: HeadAssets, identity: np.ndarray, row: dict[str, np.ndarray], size: tuple[int, int]
) -> np.ndarray:
    """[V, 3]: pixels from the top left, and depth."""
    x, y, z = posed(head, identity, row).T
    (width, height), f = size, FOCAL * max(size)
    return np.stack((CX * width + f * x / z, height - CY_FROM_BOTTOM * height + f * y / z, z), axis=1)


def identity_of() -> np.ndarray:
    identity = np.zeros(SHAPE_COEFFICIENTS)
    identity[:2] = 0.5, -0.3
    return identity


def unlimited(angles: np.ndarray, name: str) -> np.ndarray:
    """The x of angle = lo + (tanh x + 1) / 2 (hi - lo)."""
    lo, hi = np.radians(DEGREES[name]).T
    return np.arctanh(2 * (angles - lo) / (hi - lo) - 1)


def write_nha(folder: Path, frames: int = FRAMES, size: tuple[int, int] = SIZE) -> Path:
    """Its head model is FOLDER/head_model."""
    head, identity, rows = write_head(folder / "head_model"), identity_of(), true_rows(frames)
    faces, lips = head.faces.numpy(), head.regions["lips"].numpy()
    width, height = size
    for number, row in enumerate(rows):
        place = folder / f"frame_{number:04d}"
        place.mkdir()
        screen = true_screen(head, identity, row, size).astype(np.float32)
        seen = rasterize_mesh(screen, faces, height, width).face_id
        classes = np.where(seen < 0, 0, np.where(np.isin(faces, lips).all(axis=1)[seen], LIP, SKIN))
        classes[-2:] = CLOTH
        labels = np.where(seen >= 0, HEAD, 0)
        labels[-2:] = BODY
        image = np.array([[130, 110, 90], [145, 170, 215], [80, 70, 190]], np.uint8)[np.digitize(classes, (1, 12))]
        image[..., 0] += (np.arange(width) % 7).astype(np.uint8) + np.uint8(number)
        for name, pixels in (("image", image), ("seg", labels), ("parsing", classes)):
            assert cv2.imwrite(str(place / f"{name}_0000.png"), pixels.astype(np.uint8))
    values = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    values |= {name: unlimited(values[name], name) for name in DEGREES}
    values |= {"shape": identity, "K": np.array([FOCAL, CX, CY_FROM_BOTTOM]), "RT": np.eye(3, 4)}
    values |= {"texture": np.zeros((frames, 5)), "light": np.zeros((frames, 9, 3))}
    np.savez(
        folder / "tracked_flame_params_0.npz",
        frame=np.arange(frames),
        image_size=np.array([height, width]),
        **{name: value.astype(np.float32) for name, value in values.items()},
    )
    numbers = list(range(frames))
    held_out = frames - frames // 4
    (folder / "split.json").write_text(json.dumps({"train": numbers[:held_out], "val": numbers[held_out:]}))
    return folder


def edit_tracking(folder: Path, edit: Edit) -> None:
    path = folder / "tracked_flame_params_0.npz"
    values = dict(np.load(path))
    edit(values)
    np.savez(path, **values)
