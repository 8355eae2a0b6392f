"""Drive files: motion for an avatar from any tracker, as .npz, .csv or .json; docs/reenact.md is their definition.

`neck` is the head against the torso; `R` and `t` are the head's, neck included.
VHAP's tracked_flame_params*.npz and SMIRK's outputs are read by their own names (`FLAME_KEYS`), without the head's pose.
Nothing in a drive file can execute code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from avatar.errors import UserError
from avatar.files.names import as_text
from avatar.files.pickles import load_npz, save_npz
from avatar.head.assets import HeadAssets
from avatar.motion.drive import Drive
from avatar.motion.drive_csv import DEFAULT_FPS, LARGEST, read_drive_csv
from avatar.motion.drive_json import read_drive_json
from avatar.motion.drive_times import BOUNDS
from avatar.types import IDENTITY_6D, Camera, HeadParams

MAX_FRAMES = 1_000_000
MOST_TURN = math.pi * (1 + 1e-5)  # radians of a rotation vector
CAMERA_KEYS = ("R", "t", "K", "size")
FLAME_KEYS = {
    "expr": "expression",
    "jaw_pose": "jaw",
    "eyes_pose": "eyes",
    "neck_pose": "neck",
    "expression_params": "expression",
    "jaw_params": "jaw",
    "eyelid_params": "eyelids",
}
KEYS = ("expression", "jaw", "eyes", "eyelids", "neck", "fps", *CAMERA_KEYS, "shape", "names", "head")


def read_drive(path: Path | str, assets: HeadAssets, width: int, say: Callable[[str], None] = print) -> Drive:
    """A drive file for avatars of the head model `assets`; cameras are resized to `width` pixels.

    Raises UserError with the file and what is wrong with it.
    """
    path = Path(path)
    read_arkit = {".csv": read_drive_csv, ".json": read_drive_json}.get(path.suffix.lower())
    arrays = read_arkit(path, assets.num_expressions, assets.names, say) if read_arkit else load_npz(path)
    if "expression" not in arrays:
        arrays = _renamed(path, arrays)
    if "expression" not in arrays:
        raise UserError(
            f"{path} holds no expression (it holds {', '.join(sorted(arrays)) or 'nothing'}); see docs/reenact.md"
        )
    if unknown := sorted(set(arrays) - set(KEYS)):
        say(f"Note: {path.name} also holds {', '.join(unknown)}, which a drive file does not have; left unread")
    fingerprint = _text(path, arrays, "head")
    if fingerprint and fingerprint != assets.fingerprint:
        raise UserError(
            f"{path} was made for another head model than the avatar's (fingerprint {fingerprint[:12]}, the avatar's "
            f"{assets.fingerprint[:12]}): the same coefficients mean other expressions there"
        )
    expression = _numbers(path, arrays, "expression", (None, None))
    T, E = expression.shape
    if not 1 <= T <= MAX_FRAMES:
        raise UserError(f"{path} has {T} frames; from 1 to {MAX_FRAMES} can be read")
    if assets.num_expressions < E and bool((expression[:, assets.num_expressions :] != 0).any()):
        raise UserError(
            f"{path} has {E} expression coefficients, but the avatar's head model has {assets.num_expressions} directions"
        )
    if assets.num_expressions > E:
        say(f"Warning: {path.name} has {E} of {assets.num_expressions} expression coefficients; the rest are zero")
    padded = torch.zeros(T, assets.num_expressions)
    kept = min(E, assets.num_expressions)
    padded[:, :kept] = expression[:, :kept]
    jaw = _rotations(path, arrays, "jaw", T, 1)
    eyes = _rotations(path, arrays, "eyes", T, 2)
    neck = _rotations(path, arrays, "neck", T, 1)
    if "jaw" in assets.fixed_joints and bool((jaw - torch.tensor(IDENTITY_6D)).abs().amax() > 1e-4):
        say(f"Warning: {path.name} turns the jaw, but no vertex of the avatar's head model follows its jaw")
    eyelids = _numbers(path, arrays, "eyelids", (T, 2)) if "eyelids" in arrays else torch.zeros(T, 2)
    fps = float(_numbers(path, arrays, "fps", ())) if "fps" in arrays else DEFAULT_FPS
    if not BOUNDS[0] <= fps <= BOUNDS[1]:
        raise UserError(f"{path}: fps is {fps:g}, frames a second; it must lie between {BOUNDS[0]:g} and {BOUNDS[1]:g}")
    shape = _numbers(path, arrays, "shape", (None,)) if "shape" in arrays else torch.zeros(0)
    if len(shape) > assets.shape_dirs.shape[2]:
        raise UserError(f"{path}: shape has {len(shape)} values, the head model {assets.shape_dirs.shape[2]}")
    return Drive(
        path.stem,
        fps,
        _frame_names(path, arrays, T),
        [HeadParams(padded[i], jaw[i], eyes[i], eyelids[i], neck[i]) for i in range(T)],
        _cameras(path, arrays, T, width),
        shape,
    )


def write_drive(path: Path, drive: Drive, fingerprint: str) -> None:
    """Write an .npz that `read_drive` gives back. Raises UserError when the disk refuses."""
    arrays: dict[str, np.ndarray] = {
        name: torch.stack([getattr(params, name) for params in drive.params]).numpy()
        for name in ("expression", "jaw", "eyes", "eyelids", "neck")
    }
    names = [as_text(name) for name in drive.names]
    arrays |= {"fps": np.array(drive.fps), "names": np.array(names), "head": np.array(fingerprint)}
    arrays["shape"] = drive.identity.numpy()
    if drive.cameras is not None:
        first = drive.cameras[0]
        arrays["R"] = torch.stack([camera.R_cam_world for camera in drive.cameras]).numpy()
        arrays["t"] = torch.stack([camera.t_cam_world for camera in drive.cameras]).numpy()
        arrays["K"] = np.array([[first.fx, 0, first.cx], [0, first.fy, first.cy], [0, 0, 1]])
        arrays["size"] = np.array([first.width, first.height])
    save_npz(path, arrays)


def _renamed(path: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """With this module's names in place of VHAP's and SMIRK's."""
    renamed: dict[str, np.ndarray] = {}
    for key, array in arrays.items():
        name = FLAME_KEYS.get(key, key)
        if name in renamed:
            both = " and ".join(other for other in arrays if FLAME_KEYS.get(other, other) == name)
            raise UserError(f"{path} holds {name} twice, as {both}; remove one of them")
        renamed[name] = array.ravel() if key == "shape" else array
    return renamed


def _numbers(path: Path, arrays: Mapping[str, np.ndarray], key: str, shape: tuple[int | None, ...]) -> Tensor:
    """Finite float32 values of this shape, None for any size."""
    array = arrays[key]
    if array.dtype.kind not in "fiu":
        raise UserError(f"{path}: {key} holds {array.dtype} values, not real numbers")
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise UserError(f"{path}: {key} has shape {list(array.shape)}, expected [{wanted}]")
    with np.errstate(invalid="ignore", over="ignore"):  # refused below, and needs no warning before that
        bad = np.argwhere(~(np.abs(array.astype(np.float64)) <= LARGEST))
    if len(bad):
        index = tuple(bad[0].tolist())
        raise UserError(f"{path}: {key}{list(index) or ''} is {array[index]}; numbers must lie within +-{LARGEST:g}")
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def _rotations(path: Path, arrays: Mapping[str, np.ndarray], key: str, T: int, count: int) -> Tensor:
    """[T, 6 * count], from rotation vectors or 6D; the identity where the file has none."""
    if key not in arrays:
        return torch.tensor(IDENTITY_6D).repeat(T, count)
    values = _numbers(path, arrays, key, (T, None))
    if values.shape[1] == 3 * count:
        vectors = values.reshape(-1, 3)
        if bool((large := vectors.norm(dim=1) > MOST_TURN).any()):
            row = int(large.int().argmax())
            raise UserError(
                f"{path}: {key} of frame {row // count} turns by {float(vectors[row].norm()):.3g} radians, more than half "
                "a turn; give radians, not degrees"
            )
        return axis_angle_to_rotation_matrix(vectors)[:, :2].reshape(T, 6 * count)
    if values.shape[1] != 6 * count:
        raise UserError(
            f"{path}: {key} has {values.shape[1]} values a frame; {3 * count} (rotation vectors) or {6 * count} "
            "(first two rows of the matrices) are expected"
        )
    rows = values.reshape(-1, 2, 3)
    areas = torch.linalg.cross(rows[:, 0], rows[:, 1]).norm(dim=1)
    if bool((areas < 1e-3).any()):
        raise UserError(f"{path}: {key} of frame {int((areas < 1e-3).int().argmax()) // count} is not a rotation")
    return values


def _cameras(path: Path, arrays: Mapping[str, np.ndarray], T: int, width: int) -> list[Camera] | None:
    given = [key for key in CAMERA_KEYS if key in arrays]
    if not given:
        return None
    if len(given) < len(CAMERA_KEYS):
        missing = ", ".join(key for key in CAMERA_KEYS if key not in given)
        raise UserError(f"{path} has a camera without {missing}; give all of {', '.join(CAMERA_KEYS)}, or none")
    R, t = _numbers(path, arrays, "R", (T, 3, 3)), _numbers(path, arrays, "t", (T, 3))
    K, size = _numbers(path, arrays, "K", (3, 3)), _numbers(path, arrays, "size", (2,))
    off = (R @ R.mT - torch.eye(3)).abs().amax(dim=(1, 2)) > 1e-2
    if bool((off | (torch.det(R) < 0)).any()):
        raise UserError(f"{path}: R of frame {int((off | (torch.det(R) < 0)).int().argmax())} is not a rotation")
    w, h = (round(float(value)) for value in size)
    if min(w, h) < 1 or min(float(K[0, 0]), float(K[1, 1])) <= 0:
        raise UserError(f"{path}: the camera has size {w}x{h} and focal lengths {K[0, 0]:g}, {K[1, 1]:g}")
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    height = max(1, round(width * h / w))
    if height > 8 * width:
        raise UserError(f"{path}: pictures of {w}x{h} pixels are too narrow")
    return [Camera(R[i], t[i], fx, fy, cx, cy, w, h).resized(width, height) for i in range(T)]


def _frame_names(path: Path, arrays: Mapping[str, np.ndarray], T: int) -> tuple[str, ...]:
    if "names" not in arrays:
        return tuple(f"{i:05d}" for i in range(T))
    names = arrays["names"]
    if names.dtype.kind != "U" or names.shape != (T,):
        raise UserError(f"{path}: names must hold one text per frame, [{T}]; it is {names.dtype} {list(names.shape)}")
    return tuple(str(name) for name in names)


def _text(path: Path, arrays: Mapping[str, np.ndarray], key: str) -> str:
    if key not in arrays:
        return ""
    if arrays[key].dtype.kind != "U" or arrays[key].ndim != 0:
        raise UserError(f"{path}: {key} must be one text")
    return str(arrays[key])
