"""Writers of the layouts of other programs: the same small subject as `tracked_folder` makes, as they would export it.

Every writer moves the head's pose where its format has it (a fixed camera and FLAME's own rotation and translation), by
the formulas of the formats, not by those of the importers.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from avatar.data.read_image import read_mask
from avatar.head.assets import HeadAssets, load_head_assets

OPENGL = np.diag([1.0, -1.0, -1.0])  # OpenCV camera axes <-> OpenGL camera axes
R_CAM_WORLD = cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0] @ OPENGL  # any camera that is not at the origin
T_CAM_WORLD = np.array([0.05, -0.1, 0.9])
STATIC_OFFSET = 2e-3  # metres, of every vertex of VHAP's head
SPLIT = {"train": slice(0, 16), "val": slice(16, 18), "test": slice(18, None)}
INSTA_RED = {1: 250, 13: 120, 16: 90}  # skin, lower lip, cloth


@dataclass(frozen=True)
class Shot:
    """One frame of the small tracked folder."""

    number: int  # of the image
    image: np.ndarray  # BGR
    head: np.ndarray  # 0 or 255
    mouth: np.ndarray
    flame: dict[str, np.ndarray]  # as in the .frame file, without the leading axis
    R: np.ndarray
    t: np.ndarray
    K: np.ndarray
    frame_file: Path


def shots(tracked: Path, offset: int = 1) -> Iterator[Shot]:
    for path in sorted((tracked / "checkpoint").iterdir()):
        content = torch.load(path, weights_only=False)
        number = int(path.stem) + offset
        image = cv2.imread(str(next((tracked / "imgs").glob(f"{number:05d}.*"))))
        assert image is not None
        yield Shot(
            number,
            image,
            read_mask(tracked / "parsing" / f"{number:05d}_neckhead.png"),
            read_mask(tracked / "parsing" / f"{number:05d}_mouth.png"),
            {name: np.asarray(value[0], np.float64) for name, value in content["flame"].items()},
            *(np.asarray(content["opencv"][name][0], np.float64) for name in ("R", "t", "K")),
            path,
        )


def axis_angle(six_d: np.ndarray) -> np.ndarray:
    """[K * 3] rotation vectors of [K * 6] rows."""
    rows = six_d.reshape(-1, 2, 3)
    return np.concatenate([cv2.Rodrigues(np.stack((a, b, np.cross(a, b))))[0].ravel() for a, b in rows])


def root_joint(head: HeadAssets, shot: Shot) -> np.ndarray:
    """[3]: the regressed root of the head with this identity and expression."""
    shape, expression = shot.flame["shape"], shot.flame["exp"]
    vertices = head.template.double().numpy() + head.shape_dirs.double().numpy() @ shape
    vertices = vertices + head.expression_dirs.double().numpy()[:, :, : len(expression)] @ expression
    return head.joint_regressor[0].double().numpy() @ vertices


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_listings(folder: Path, frames: list[dict[str, Any]], shared: dict[str, Any], *, divided: bool) -> None:
    parts = {f"transforms_{name}": frames[part] for name, part in SPLIT.items()} if divided else {"transforms": frames}
    for name, part in parts.items():
        (folder / f"{name}.json").write_text(json.dumps({**shared, "frames": part}))


def write_vhap(
    tracked: Path,
    folder: Path,
    *,
    divided: bool = True,
    masks: bool = True,
    angle: bool = False,
    camera: str | None = None,
    edit: Callable[[int, dict[str, np.ndarray]], None] = lambda number, values: None,
) -> Path:
    """`angle` gives the intrinsics as camera_angle_x; `camera` is written as the frames' camera_id."""
    head = load_head_assets(tracked / "head_model")
    folder.mkdir(parents=True, exist_ok=True)
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = R_CAM_WORLD.T @ OPENGL
    camera_to_world[:3, 3] = -R_CAM_WORLD.T @ T_CAM_WORLD
    frames, shared = [], {}
    for step, shot in enumerate(shots(tracked)):
        name = f"{step:05d}_00"
        write_image(folder / "images" / f"{name}.png", shot.image)
        if masks:
            write_image(folder / "fg_masks" / f"{name}.png", shot.head)
        # Joints come from the shape with the static offset, and the regressor's weights sum to 1.
        root = root_joint(head, shot) + STATIC_OFFSET
        rotation = R_CAM_WORLD.T @ shot.R
        values = {
            "translation": (R_CAM_WORLD.T @ (shot.t - T_CAM_WORLD) - root + rotation @ root)[None],
            "rotation": cv2.Rodrigues(rotation)[0].reshape(1, 3),
            "neck_pose": np.zeros((1, 3)),
            "jaw_pose": axis_angle(shot.flame["jaw"])[None],
            "eyes_pose": axis_angle(shot.flame["eyes"])[None],
            "shape": shot.flame["shape"],
            "expr": np.pad(shot.flame["exp"], (0, 90))[None],
            "static_offset": np.full((1, head.num_vertices + 5, 3), STATIC_OFFSET),  # its head has teeth as well
        }
        edit(step, values)
        (folder / "flame_param").mkdir(exist_ok=True)
        np.savez(folder / "flame_param" / f"{step:05d}.npz", **{k: v.astype(np.float32) for k, v in values.items()})
        height, width = shot.head.shape
        shared = {"w": width, "h": height}
        if angle:
            shared |= {"camera_angle_x": 2 * np.arctan(width / (2 * shot.K[0, 0]))}
        else:
            shared |= {"fl_x": shot.K[0, 0], "fl_y": shot.K[1, 1], "cx": shot.K[0, 2]}
            shared |= {"cy": height - shot.K[1, 2]}  # counted from the bottom
        entry = {
            "timestep_index": step,
            "camera_index": 0,
            "transform_matrix": camera_to_world.tolist(),
            "file_path": f"images/{name}.png",
            "flame_param_path": f"flame_param/{step:05d}.npz",
        }
        entry |= {"fg_mask_path": f"fg_masks/{name}.png"} if masks else {}
        entry |= {"camera_id": camera} if camera else {}
        frames.append(entry)
    write_listings(folder, frames, shared, divided=divided)
    return folder


def write_imavatar(tracked: Path, folder: Path, *, old_intrinsics: bool = False, subfolders: bool = False) -> Path:
    """One flame_params.json, or (`subfolders`) one in train/ and one in test/."""
    head = load_head_assets(tracked / "head_model")
    frames: list[tuple[Path, dict[str, Any]]] = []
    shared: dict[str, Any] = {}
    for step, shot in enumerate(shots(tracked)):
        part = ("test" if step >= 18 else "train") if subfolders else "."
        name = str(step + 1)
        write_image(folder / part / "image" / f"{name}.png", shot.image)
        write_image(folder / part / "mask" / f"{name}.png", shot.head)
        write_image(folder / part / "semantic" / f"{name}.png", np.where(shot.mouth > 0, 13, shot.head // 255))
        root = root_joint(head, shot)
        # No translation of FLAME's: FLAME turns the head about its root, the camera looks at it from where it is.
        rotation = R_CAM_WORLD.T @ shot.R
        translation = 4 * (shot.t + shot.R @ root - R_CAM_WORLD @ root)
        pose = [cv2.Rodrigues(rotation)[0].ravel(), np.zeros(3)]
        pose += [axis_angle(shot.flame["jaw"]), axis_angle(shot.flame["eyes"])]
        entry = {
            "file_path": f"./image/{name}",
            "world_mat": (OPENGL @ np.column_stack((R_CAM_WORLD, translation))).tolist(),
            "expression": np.pad(shot.flame["exp"], (0, 40)).tolist(),
            "pose": np.concatenate(pose).tolist(),
            "bbox": [-0.5, -0.5, 0.5, 0.5],
        }
        frames.append((folder / part, entry))
        height, width = shot.head.shape
        unit = np.array([width, height, width, height]) / (512 if old_intrinsics else 1)
        focal = np.array([-shot.K[0, 0], shot.K[1, 1], shot.K[0, 2], shot.K[1, 2]])
        shared = {"intrinsics": (focal / unit).tolist(), "shape_params": shot.flame["shape"][:100].tolist()}
    for place in {place for place, _ in frames}:
        entries = [entry for other, entry in frames if other == place]
        (place / "flame_params.json").write_text(json.dumps({**shared, "frames": entries}))
    return folder


def write_insta(tracked: Path, folder: Path, *, checkpoint: bool = True, matted: bool = False) -> Path:
    """`matted` puts the matte into matted/ instead of the images' own transparency."""
    frames: list[dict[str, Any]] = []
    shared: dict[str, Any] = {}
    for shot in shots(tracked):
        name = shot.frame_file.stem
        with_matte = np.dstack((shot.image, shot.head))
        write_image(folder / "images" / f"{name}.png", shot.image if matted else with_matte)
        if matted:
            write_image(folder / "matted" / f"{name}.png", with_matte)
        classes = np.where(shot.mouth > 0, INSTA_RED[13], np.where(shot.head > 0, INSTA_RED[1], 0))
        classes[-2:] = INSTA_RED[16]  # cloth is not head
        parsing = np.zeros_like(shot.image)
        parsing[..., 2] = classes
        write_image(folder / "seg_mask" / f"{name}.png", parsing)
        (folder / "flame" / "exp").mkdir(parents=True, exist_ok=True)
        np.savetxt(folder / "flame" / "exp" / f"{name}.txt", shot.flame["exp"], fmt="%.8f")
        if checkpoint:
            (folder / "checkpoint").mkdir(exist_ok=True)
            shutil.copy(shot.frame_file, folder / "checkpoint" / shot.frame_file.name)
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3], world_to_camera[:3, 3] = shot.R, shot.t
        frames.append(
            {
                "transform_matrix": np.linalg.inv(world_to_camera).tolist(),
                "file_path": f"images/{name}.png",
                "mesh_path": f"meshes/{name}.obj",
                "exp_path": f"flame/exp/{name}.txt",
                "depth_path": f"depth/{name}.png",
                "seg_mask_path": f"seg_mask/{name}.png",
            }
        )
        height, width = shot.head.shape
        shared = {"w": float(width), "h": float(height), "fl_x": shot.K[0, 0], "fl_y": shot.K[1, 1]}
        shared |= {"cx": shot.K[0, 2], "cy": shot.K[1, 2]}
    # The exporter's order is that in which its processes finished.
    order = np.random.default_rng(0).permutation(len(frames))
    for name, part in {"train": slice(0, 18), "test": slice(18, None), "val": slice(-3, None)}.items():
        chosen = set(range(len(frames))[part])
        listed = [frames[i] for i in order if i in chosen]
        (folder / f"transforms_{name}.json").write_text(json.dumps({**shared, "frames": listed}))
    return folder
