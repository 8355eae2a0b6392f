"""A person filmed by several cameras, in the layout of VHAP's export, written from the facts of that layout.

The head of `tracked_folder` moves before a front camera; other cameras stand around it. `cy` is counted from the bottom,
every camera's principal point is off the centre, and each sequence has a world of its own.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from tracked_folder import SHAPE_COEFFICIENTS, motion, render, rotation, write_head_model

from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.formats.root_pose import rotation_matrix
from data_prep.prepare.prepare import prepare

WIDTH, HEIGHT, FOCAL = 64, 56, 160.0
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
CENTRE = np.array([0.0, 0.0, 0.8])  # of the head, before the front camera
AZIMUTHS = {"07": -35.0, "08": 0.0, "12": 40.0}  # degrees, by camera; 08 is the front


@dataclass(frozen=True)
class Sequence:
    name: str
    times: int
    seed: int
    world: np.ndarray  # [4, 4], of the front camera in this sequence's world, OpenCV's axes


SEQUENCES = (
    Sequence("EMO", 6, 0, np.eye(4)),
    Sequence("FREE", 4, 1, np.block([[rotation(0.2, -0.4, 0.1), np.array([[0.3], [-0.1], [0.5]])], [0, 0, 0, 1]])),
)


def from_front(name: str) -> np.ndarray:
    """[4, 4] from the front camera's axes to those of a camera that looks at the head's centre from aside."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(0, np.radians(AZIMUTHS[name]), 0)
    pose[:3, 3] = CENTRE - pose[:3, :3] @ CENTRE
    return pose


def lens(name: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy from the top."""
    return FOCAL, FOCAL + 4, WIDTH / 2 + 0.1 * AZIMUTHS[name], HEIGHT / 2 - 3.0 + 0.05 * AZIMUTHS[name]


def root_joint(head: HeadModel, track: dict[str, np.ndarray]) -> np.ndarray:
    params_shape = head.neutral_vertices().double().numpy()
    moved = params_shape + head.assets.expression_dirs.double().numpy() @ track["expression"]
    return head.assets.joint_regressor[0].double().numpy() @ moved


def axis_angle(six_d: np.ndarray) -> np.ndarray:
    rows = six_d.reshape(-1, 2, 3)
    return np.concatenate([cv2.Rodrigues(np.stack((a, b, np.cross(a, b))))[0].ravel() for a, b in rows])


def write_sequence(root: Path, sequence: Sequence, cameras: tuple[str, ...] = tuple(AZIMUTHS)) -> list[dict[str, Any]]:
    """Write ROOT/NAME and return its entries; the caller writes the listing."""
    head_folder = root / "head_model"
    assets = write_head_model(head_folder)
    identity = np.zeros(SHAPE_COEFFICIENTS, np.float32)
    identity[:2] = 0.5, -0.3
    head = HeadModel(assets, torch.from_numpy(identity))
    folder = root / sequence.name
    for name in ("images", "fg_masks", "flame_param"):
        (folder / name).mkdir(parents=True)
    entries = []
    for time, track in enumerate(motion(sequence.times, assets.num_expressions, sequence.seed)):
        track["eyelids"] = np.zeros(2)  # which the layout has no place for
        write_parameters(folder / "flame_param" / f"{time:05d}.npz", sequence, track, identity, head)
        for name in cameras:
            pose = from_front(name)
            fx, fy, cx, cy = lens(name)
            content = frame(track, identity, pose, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
            image, mask, _ = render(head, content, WIDTH, HEIGHT)
            stem = f"{time:05d}_{name}"
            assert cv2.imwrite(str(folder / "images" / f"{stem}.png"), image[..., ::-1])
            assert cv2.imwrite(str(folder / "fg_masks" / f"{stem}.png"), mask * 255)
            camera_in_world = sequence.world @ np.linalg.inv(pose)
            entries.append(
                {
                    "timestep_index": time,
                    "camera_index": list(AZIMUTHS).index(name),
                    "camera_id": name,
                    "fl_x": fx,
                    "fl_y": fy,
                    "cx": cx,
                    "cy": HEIGHT - cy,
                    "w": WIDTH,
                    "h": HEIGHT,
                    "transform_matrix": (camera_in_world @ OPENGL).tolist(),
                    "file_path": f"images/{stem}.png",
                    "fg_mask_path": f"fg_masks/{stem}.png",
                    "flame_param_path": f"flame_param/{time:05d}.npz",
                }
            )
    return entries


def frame(track: dict[str, np.ndarray], identity: np.ndarray, pose: np.ndarray, K: np.ndarray) -> dict[str, Any]:
    flame = {"exp": track["expression"], "shape": identity} | {k: track[k] for k in ("eyes", "eyelids", "jaw")}
    R, t = pose[:3, :3] @ track["R"], pose[:3, :3] @ track["t"] + pose[:3, 3]
    return {
        "flame": {name: value[None].astype(np.float32) for name, value in flame.items()},
        "opencv": {name: value[None].astype(np.float32) for name, value in (("R", R), ("t", t), ("K", K))},
    }


def write_parameters(
    path: Path, sequence: Sequence, track: dict[str, np.ndarray], identity: np.ndarray, head: HeadModel
) -> None:
    """FLAME turns the head about its root joint, then moves it: v -> Q (v - j) + j + translation, in the world."""
    Q, shift = sequence.world[:3, :3] @ track["R"], sequence.world[:3, :3] @ track["t"] + sequence.world[:3, 3]
    turn = cv2.Rodrigues(Q)[0].ravel()
    joint = root_joint(head, track)
    values = {
        "translation": (shift - joint + rotation_matrix(turn) @ joint)[None],
        "rotation": turn[None],
        "neck_pose": np.zeros((1, 3)),
        "jaw_pose": axis_angle(track["jaw"])[None],
        "eyes_pose": axis_angle(track["eyes"])[None],
        "shape": identity,
        "expr": np.pad(track["expression"], (0, 100 - len(track["expression"])))[None],
    }
    np.savez(path, **{name: value.astype(np.float32) for name, value in values.items()})


def write_listings(folder: Path, entries: dict[str | None, list[dict[str, Any]]]) -> Path:
    """transforms_SPLIT.json, or transforms.json for None."""
    folder.mkdir(exist_ok=True)
    for split, frames in entries.items():
        name = "transforms.json" if split is None else f"transforms_{split}.json"
        (folder / name).write_text(json.dumps({"frames": frames, "fps": 25.0}))
    return folder


def write_single(root: Path, **changes: Any) -> Path:
    """One sequence as VHAP splits it: every camera tests the last times, and 08 validates at the others."""
    sequence = SEQUENCES[0]
    entries = write_sequence(root, sequence, **changes)
    early = [entry for entry in entries if entry["timestep_index"] < 4]
    return write_listings(
        root / sequence.name,
        {
            "train": [entry for entry in early if entry["camera_id"] != "08"],
            "val": [entry for entry in early if entry["camera_id"] == "08"],
            "test": [entry for entry in entries if entry["timestep_index"] >= 4],
        },
    )


def write_union(root: Path) -> Path:
    """Both sequences joined by listings alone; FREE is tested."""
    joined: dict[str | None, list[dict[str, Any]]] = {"train": [], "val": [], "test": []}
    time = 0
    for sequence in SEQUENCES:
        for entry in write_sequence(root, sequence):
            paths = {key: f"../{sequence.name}/{entry[key]}" for key in entry if key.endswith("_path")}
            split = "test" if sequence.name == "FREE" else "val" if entry["camera_id"] == "08" else "train"
            joined[split].append(entry | paths | {"timestep_index": time + entry["timestep_index"]})
        time += sequence.times
    folder = write_listings(root / "UNION_someone", joined)
    (folder / "sequences_trainval.txt").write_text("EMO\n")
    (folder / "sequences_test.txt").write_text("FREE\n")
    return folder


def edited(folder: Path, copy: Path, edit: Any) -> Path:
    """The folder with every listed entry of every listing edited; paths stay where they were."""
    shutil.copytree(folder.parent, copy)
    for listing in (copy / folder.name).glob("transforms_*.json"):
        content = json.loads(listing.read_text())
        content["frames"] = [entry for entry in content["frames"] if edit(entry) is not False]
        listing.write_text(json.dumps(content))
    return copy / folder.name


def opened(folder: Path, out: Path, test_frames: int | None = None, test_cameras: str | None = None, **options: Any):
    head = folder.parent / "head_model"
    said: list[str] = []
    prepared = prepare(
        Source(folder, head, **options),
        load_head_assets(head),
        out=out,
        test_frames=test_frames,
        test_cameras=test_cameras,
        say=said.append,
    )
    return Subject.open(prepared), said
