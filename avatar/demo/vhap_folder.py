"""The demo person filmed by many cameras, in the layout of VHAP's export and of GaussianAvatars' input.

    OUT/SPEECH, OUT/GAZE, OUT/FREE     one export for each sequence
      transforms.json                  all frames
      transforms_{train,val,test}.json the first 70 % of the times (val: by the front camera), and the rest
      images/00000_00.png              time and camera
      fg_masks/00000_00.png            coverage of head and neck
      flame_param/00000.npz            one time's FLAME parameters
      canonical_flame_param.npz        the person at rest, jaw open by 0.3
    OUT/UNION_demo0                    listings of all sequences; FREE is the test, the front camera the validation
    OUT/head_model                     of all of them; each folder has it as well

The cameras and parameters are the truth. The layout has no eyelids: the person does not blink.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from tqdm import tqdm

from avatar.compute.native import thread_count
from avatar.compute.workers import in_order
from avatar.demo.cameras import World, front_camera, root_joint, studio_cameras, world_of
from avatar.demo.head_files import write_head_model
from avatar.demo.performance import FPS, Motion, Performance, frame_camera, frame_params, perform
from avatar.demo.render import VIEW_AXES, PosedScene, Renderer, renderer_of
from avatar.demo.subject import check_arguments, check_number, single_threads
from avatar.files.atomic import check_target, whole_folder
from avatar.files.write_image import write_image
from avatar.head.model import matrix_from_6d
from avatar.types import Camera, HeadParams

SEQUENCES: tuple[tuple[str, Motion], ...] = (("SPEECH", "speech"), ("GAZE", "gaze"), ("FREE", "turn"))
TEST_SEQUENCE = "FREE"
TRAIN_SHARE = 0.7  # of a single sequence's times
MAX_CAMERAS = 64
SPLITS = ("train", "val", "test")
Entry = dict[str, Any]


class Sequence(NamedTuple):
    name: str
    number: int
    performance: Performance
    world: World


def make_camera_folder(out: Path, cameras: int, frames: int = 100, size: int = 256, seed: int = 0) -> Path:
    """Film the person of `seed` by `cameras` cameras over 120 degrees, three sequences of `frames` times each.

    The folder appears under its name only when it is complete. Same arguments, same files. Returns the folder of the
    union of the sequences. Raises UserError for values out of range and for a folder that is not empty.
    """
    out = Path(out)
    check_arguments(frames, size, seed, "speech")
    check_number("with several cameras, frames", frames, 2)
    check_number("cameras", cameras, 2, MAX_CAMERAS)
    union = f"UNION_demo{seed}"
    check_target(out)
    with whole_folder(out) as folder:
        renderer = renderer_of(seed)
        head_model = folder / "head_model"
        write_head_model(head_model, renderer.performer.head)
        studio = studio_cameras(cameras, size)
        sequences = [
            Sequence(name, k, _without_blinks(perform(seed, frames, motion, take=k)), world_of(seed, k))
            for k, (name, motion) in enumerate(SEQUENCES)
        ]
        for sequence in sequences:
            _prepare_sequence(folder / sequence.name, renderer, sequence, studio, frames)
        _write_union(folder / union, sequences, studio, frames)
        for name in (*(sequence.name for sequence in sequences), union):
            shutil.copytree(head_model, folder / name / "head_model", copy_function=_link)
        _film(folder, renderer, sequences, studio, frames)
    return out / union


def _without_blinks(performance: Performance) -> Performance:
    return performance._replace(eyelids=np.zeros_like(performance.eyelids))


def _link(source: str, place: str) -> None:
    """One file under two names where the file system has that, else a copy."""
    try:
        os.link(source, place)
    except OSError:
        shutil.copyfile(source, place)


def _head_pose(performance: Performance, time: int) -> tuple[np.ndarray, np.ndarray]:
    """From the head's space to the studio: R [3, 3], t [3]; float32."""
    in_front = frame_camera(performance, time, 1)
    return VIEW_AXES @ in_front.R_cam_world.numpy(), VIEW_AXES @ in_front.t_cam_world.numpy()


def _film(folder: Path, renderer: Renderer, sequences: list[Sequence], studio: list[Camera], frames: int) -> None:
    """Write the pictures and mattes; each time is posed once for all cameras."""

    def film(place: tuple[Sequence, int]) -> None:
        sequence, time = place
        params = frame_params(sequence.performance, time)
        scene = renderer.pose_scene(params, *_head_pose(sequence.performance, time))
        for index, camera in enumerate(studio):
            _write_picture(folder / sequence.name, time, index, renderer, scene, camera)

    places = [(sequence, time) for sequence in sequences for time in range(frames)]
    total, workers = len(places) * len(studio), thread_count()  # before each of them has one thread
    with single_threads(), tqdm(total=total, desc="rendering", unit="image") as progress:
        for _ in in_order(film, places, workers):
            progress.update(len(studio))


def _write_picture(folder: Path, time: int, index: int, renderer: Renderer, scene: PosedScene, camera: Camera) -> None:
    """The matte ends below the neck, where GaussianAvatars' pictures are cut."""
    picture = renderer.render_scene(scene, camera)
    write_image(folder / _image(time, index), picture.image)
    write_image(folder / _matte(time, index), picture.head)


def _image(time: int, camera: int) -> str:
    return f"images/{time:05d}_{camera:02d}.png"


def _matte(time: int, camera: int) -> str:
    return f"fg_masks/{time:05d}_{camera:02d}.png"


def _parameters(time: int) -> str:
    return f"flame_param/{time:05d}.npz"


def _prepare_sequence(folder: Path, renderer: Renderer, sequence: Sequence, studio: list[Camera], frames: int) -> None:
    """Everything of a sequence but its pictures."""
    for name in ("images", "fg_masks", "flame_param"):
        (folder / name).mkdir(parents=True)
    head, shape = renderer.performer.head, renderer.identity.shape
    for time in range(frames):
        params = frame_params(sequence.performance, time)
        rotation, translation = sequence.world.root_pose(
            *_head_pose(sequence.performance, time), root_joint(head, shape, params)
        )
        _write_flame(folder / _parameters(time), shape, len(head.template), params, rotation, translation)
    rest = frame_params(_at_rest(), 0)
    _write_flame(folder / "canonical_flame_param.npz", shape, len(head.template), rest, np.zeros(3), np.zeros(3))

    entries = list(_entries(sequence, studio, frames))
    last_trained = min(max(1, int(TRAIN_SHARE * frames)), frames - 1)
    parts: dict[str, list[Entry]] = {split: [] for split in SPLITS}
    for entry in entries:
        parts[_split(entry, entry["timestep_index"] >= last_trained, len(studio))].append(entry)
    _write_listing(folder / "transforms.json", entries)
    for split, own in parts.items():
        _write_listing(folder / f"transforms_{split}.json", own)


def _write_union(folder: Path, sequences: list[Sequence], studio: list[Camera], frames: int) -> None:
    """The listings of all sequences, with times that count through, and which of the sequences are the test."""
    folder.mkdir()
    parts: dict[str, list[Entry]] = {split: [] for split in SPLITS}
    for sequence in sequences:
        for entry in _entries(sequence, studio, frames):
            del entry["timestep_id"]
            entry["timestep_index"] += sequence.number * frames
            for key in ("file_path", "fg_mask_path", "flame_param_path"):
                entry[key] = f"../{sequence.name}/{entry[key]}"
            parts[_split(entry, sequence.name == TEST_SEQUENCE, len(studio))].append(entry)
    for split, own in parts.items():
        _write_listing(folder / f"transforms_{split}.json", own)
    names = [sequence.name for sequence in sequences if sequence.name != TEST_SEQUENCE]
    (folder / "sequences_trainval.txt").write_text("".join(f"{name}\n" for name in names), encoding="ascii")
    (folder / "sequences_test.txt").write_text(f"{TEST_SEQUENCE}\n", encoding="ascii")


def _split(entry: Entry, is_test: bool, cameras: int) -> str:
    if is_test:
        return "test"
    return "val" if entry["camera_index"] == front_camera(cameras) else "train"


def _entries(sequence: Sequence, studio: list[Camera], frames: int) -> Iterator[Entry]:
    """One for each picture of a sequence, by time and then by camera."""
    for time in range(frames):
        for index, camera in enumerate(studio):
            yield {
                "timestep_index": time,
                "timestep_index_original": time,
                "timestep_id": f"frame_{time:05d}",
                "camera_index": index,
                "camera_id": f"cam_{index:02d}",
                **_intrinsics(camera),
                "transform_matrix": sequence.world.camera_to_world(camera).tolist(),
                "file_path": _image(time, index),
                "fg_mask_path": _matte(time, index),
                "flame_param_path": _parameters(time),
            }


def _intrinsics(camera: Camera) -> Entry:
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.height - camera.cy,  # from the bottom
        "h": camera.height,
        "w": camera.width,
        "camera_angle_x": 2.0 * float(np.arctan(0.5 * camera.width / camera.fx)),
        "camera_angle_y": 2.0 * float(np.arctan(0.5 * camera.height / camera.fy)),
    }


def _write_listing(file: Path, entries: list[Entry]) -> None:
    """The shared intrinsics are those of the first entry, as in an export; every entry has its own."""
    intrinsics = ("cx", "cy", "fl_x", "fl_y", "h", "w", "camera_angle_x", "camera_angle_y")
    listing = {
        "frames": entries,
        **{key: entries[0][key] for key in intrinsics},
        "timestep_indices": sorted({entry["timestep_index"] for entry in entries}),
        "camera_indices": sorted({entry["camera_index"] for entry in entries}),
        "fps": FPS,
    }
    file.write_text(json.dumps(listing, indent=1, allow_nan=False) + "\n", encoding="ascii")


def _at_rest() -> Performance:
    """No expression, the jaw open by 0.3 radians."""
    one = np.zeros((1, 3))
    return Performance(np.zeros((1, 100)), np.array([0.3]), one[:, :2], one[:, :2], one, one)


def _write_flame(
    file: Path, shape: np.ndarray, vertices: int, params: HeadParams, rotation: np.ndarray, translation: np.ndarray
) -> None:
    jaw, *eyes = (matrix_from_6d(six).numpy() for six in (params.jaw, *params.eyes.reshape(2, 6)))
    arrays = {
        "translation": translation[None],
        "rotation": rotation[None],
        "neck_pose": np.zeros((1, 3)),
        "jaw_pose": _axis_angle(jaw)[None],
        "eyes_pose": np.concatenate([_axis_angle(R) for R in eyes])[None],
        "expr": params.expression.numpy()[None],
        "shape": shape,
        "static_offset": np.zeros((1, vertices, 3)),
    }
    np.savez_compressed(file, **{name: values.astype(np.float32) for name, values in arrays.items()})


def _axis_angle(R: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(R.astype(np.float64))[0][:, 0]
