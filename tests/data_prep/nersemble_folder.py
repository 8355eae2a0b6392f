"""One person of NeRSemble's benchmark for monocular FLAME avatars, written from the facts of that layout.

    <id>/calibration/camera_params.json
    <id>/sequences/<SEQ>/{images,alpha_maps}/cam_<serial>.mp4
    <id>/sequences/<SEQ>/tracking/flame2023_tracking_v2.npz

A vertex of FLAME without a global turn is at scale * Q v + translation in the world: about the model's origin.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from camera_rig_folder import CENTRE, axis_angle, frame
from tracked_folder import SHAPE_COEFFICIENTS, motion, render, rotation, write_head_model

from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.files.video import video_writer
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.prepare.prepare import prepare

WIDTH, HEIGHT, FOCAL, SCALE = 72, 64, 170.0, 1.25
RATE = 24.0
TRAINED, ASIDE = "222200037", "222200046"
AZIMUTHS = {TRAINED: 0.0, ASIDE: 35.0}  # degrees
SEQUENCES = {"EMO-1-shout+laugh": (4, 2), "EXP-1-head": (6, 0), "SEN-01-cramp_small_danger": (4, 1)}  # times, seed
WORLD = np.block([[rotation(0.2, -0.4, 0.1), np.array([[0.3], [-0.1], [0.5]])], [0, 0, 0, 1]])  # of the trained camera

Edit = Callable[[dict[str, np.ndarray]], object]


def from_trained(serial: str) -> np.ndarray:
    """[4, 4] from the trained camera's axes to those of one that looks at the head's centre from aside; unscaled."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(0, np.radians(AZIMUTHS[serial]), 0)
    pose[:3, 3] = CENTRE - pose[:3, :3] @ CENTRE
    return pose


def lens(serial: str) -> np.ndarray:
    """Its principal point is off the middle of the picture."""
    return np.array([[FOCAL, 0, 33.0 + 0.1 * AZIMUTHS[serial]], [0, FOCAL + 4, 30.5], [0, 0, 1]])


def write_person(
    root: Path,
    *,
    cameras: Sequence[str] = tuple(AZIMUTHS),
    sequences: Sequence[str] = tuple(SEQUENCES),
    positions: Sequence[int] | None = None,
) -> Path:
    """ROOT/393 with its head model. `positions` of the first tracked pictures in the videos (default: all)."""
    folder = root / "393"
    assets = write_head_model(folder / "head_model")
    identity = np.zeros(SHAPE_COEFFICIENTS, np.float32)
    identity[:2] = 0.5, -0.3
    head = HeadModel(assets, torch.from_numpy(identity))
    for name in sequences:
        times, seed = SEQUENCES[name]
        rows = list(range(times)) if positions is None else list(positions[:times])
        tracks = motion(times, assets.num_expressions, seed)
        for track in tracks:
            track["eyelids"] = np.zeros(2)  # which the layout has no place for
        place = folder / "sequences" / name
        for serial in cameras:
            shown = [render_track(head, track, identity, serial) for track in tracks]
            pictures = [shown[rows.index(n)] if n in rows else shown[-1] for n in range(max(rows) + 1)]
            write_video(place / "images" / f"cam_{serial}.mp4", [image for image, _ in pictures])
            write_video(place / "alpha_maps" / f"cam_{serial}.mp4", [matte for _, matte in pictures])
        write_tracking(place / "tracking" / "flame2023_tracking_v2.npz", tracks, identity, rows)
    calibration = {
        "world_2_cam": {serial: scaled(from_trained(serial) @ np.linalg.inv(WORLD)).tolist() for serial in cameras},
        "intrinsics": {serial: lens(serial).tolist() for serial in cameras},
    }
    (folder / "calibration").mkdir()
    (folder / "calibration" / "camera_params.json").write_text(json.dumps(calibration))
    return folder


def render_track(
    head: HeadModel, track: dict[str, np.ndarray], identity: np.ndarray, serial: str
) -> tuple[np.ndarray, np.ndarray]:
    """Picture and matte, RGB."""
    image, mask, _ = render(head, frame(track, identity, from_trained(serial), lens(serial)), WIDTH, HEIGHT)
    return image, np.repeat(mask[..., None] * np.uint8(255), 3, axis=2)


def write_video(path: Path, pictures: Sequence[np.ndarray]) -> None:
    with video_writer(path, RATE, "veryfast") as add:
        for picture in pictures:
            add(picture)


def scaled(pose: np.ndarray) -> np.ndarray:
    """Of a world that is SCALE times as large as the head model."""
    return np.block([[pose[:3, :3], SCALE * pose[:3, 3:]], [0, 0, 0, 1]])


def write_tracking(path: Path, tracks: list[dict[str, np.ndarray]], identity: np.ndarray, rows: list[int]) -> None:
    turns = np.stack([WORLD[:3, :3] @ track["R"] for track in tracks])
    values = {
        "shape": identity[None],
        "expression": np.stack([np.pad(track["expression"], (0, 90)) for track in tracks]),
        "rotation": np.stack([euler_xyz(turn) for turn in turns]),
        "rotation_matrices": turns,
        "translation": SCALE * np.stack([WORLD[:3, :3] @ track["t"] + WORLD[:3, 3] for track in tracks]),
        "jaw": np.stack([axis_angle(track["jaw"]) for track in tracks]),
        "neck": np.zeros((len(tracks), 3)),
        "eyes": np.stack([axis_angle(track["eyes"]) for track in tracks]),
        "scale": np.array([[SCALE]]),
    }
    path.parent.mkdir()
    np.savez(path, frames=np.array(rows), **{name: value.astype(np.float32) for name, value in values.items()})


def euler_xyz(turn: np.ndarray) -> np.ndarray:
    """Angles [3] with turn = Rx Ry Rz."""
    return np.array([np.arctan2(-turn[1, 2], turn[2, 2]), np.arcsin(turn[0, 2]), np.arctan2(-turn[0, 1], turn[0, 0])])


def edit_tracking(folder: Path, edit: Edit, sequences: Sequence[str] = tuple(SEQUENCES)) -> None:
    for name in sequences:
        path = folder / "sequences" / name / "tracking" / "flame2023_tracking_v2.npz"
        values = dict(np.load(path))
        edit(values)
        np.savez(path, **values)


def edit_video(path: Path, edit: Callable[[list[np.ndarray]], list[np.ndarray]]) -> None:
    reader = cv2.VideoCapture(str(path))
    pictures = []
    while (read := reader.read())[0]:
        pictures.append(np.ascontiguousarray(read[1][..., ::-1]))
    reader.release()
    write_video(path, edit(pictures))


def video(folder: Path, serial: str = TRAINED, sequence: str = "EMO-1-shout+laugh", kind: str = "images") -> Path:
    return folder / "sequences" / sequence / kind / f"cam_{serial}.mp4"


def opened(folder: Path, out: Path, test_cameras: str | None = None, **options: Any) -> tuple[Subject, list[str]]:
    said: list[str] = []
    head = folder / "head_model"
    source = Source(folder, head, **options)
    prepared = prepare(source, load_head_assets(head), out=out, test_cameras=test_cameras, say=said.append)
    return Subject.open(prepared), said
