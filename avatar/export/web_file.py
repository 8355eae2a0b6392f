"""The avatar as browsers read it: a gzip file of a JSON header and arrays, quantised where the picture does not mind.

    bytes 0-3    "AVW4"
    bytes 4-7    length of the header, uint32, little-endian like everything
    header       JSON: sizes, arrays (type, offset, length, columns, scales), motion, camera, names
    arrays       each at a multiple of 4 bytes

A value of an integer array with scales is an integer times the scale of its column, where columns run fastest, or of its
row.
"""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from avatar.errors import UserError
from avatar.export.default_view import front_camera
from avatar.export.face_map import face_map
from avatar.export.licence import SKINNING, licence_of
from avatar.export.web_arrays import ARRAYS, WebArrays, reduce_avatar
from avatar.gaussians.head_rotation import LIMIT
from avatar.motion.controls import joint_ranges
from avatar.runs.trained_avatar import TrainedAvatar

FORMAT = "AVW4"
Precision = Literal["float", "small"]
TYPES = {"f4": np.float32, "i2": np.int16, "i1": np.int8, "u4": np.uint32, "u2": np.uint16}
# With precision "small": the type, what a column with a scale of its own is, and the largest integer, which is smaller than
# the type's where the picture does not mind, for gzip. What is not named stays float32.
SMALL: dict[str, tuple[str, str, int]] = {
    "expression_dirs": ("i2", "row", 32767),
    "pose_dirs": ("i1", "row", 127),
    "eyelid_dirs": ("i2", "row", 32767),
    "barycentric": ("i2", "all", 4095),
    "of_code": ("i2", "column", 32767),
    "hidden_weights": ("i2", "all", 32767),
    "grid_weights": ("i2", "all", 32767),
    "head_matrix": ("i1", "last two", 31),
    "head_bias": ("i2", "column", 2047),
    "quats": ("i2", "column", 2047),
    "log_scales": ("i2", "column", 2047),
    "opacity_logits": ("i2", "all", 1023),
    "sh": ("i1", "last two", 63),
    "skull_share": ("i2", "all", 1023),
}
MAX_MOTION = 1500  # frames: a minute at 25 a second


@dataclass(frozen=True)
class WebFile:
    data: bytes  # gzip
    drawing: WebArrays


def encode_avatar(trained: TrainedAvatar, precision: Precision = "small") -> WebFile:
    """The file's bytes. "float" keeps every parameter as it is. Raises UserError for values that are not finite."""
    drawing = reduce_avatar(trained)
    blocks: list[bytes] = []
    entries: dict[str, Any] = {}
    offset = 0

    def add(name: str, values: np.ndarray, scales: np.ndarray | None = None, by_row: bool = False) -> None:
        nonlocal offset
        kind = values.dtype.str[1:]
        entry: dict[str, Any] = {"type": kind, "offset": offset, "length": int(values.size)}
        if scales is not None:
            entry["scales"] = [float(f"{s:.7g}") for s in scales]
            if by_row:
                entry["by"] = "row"
        data = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes()
        data += b"\0" * (-len(data) % 4)
        blocks.append(data)
        entries[name] = entry
        offset += len(data)

    for name in ARRAYS:
        if not np.isfinite(drawing.arrays[name]).all():
            raise UserError(f"the array {name} of {trained.source} would hold values that are not finite; train again")
        if precision == "small" and name in SMALL and drawing.arrays[name].size:
            add(name, *quantised(drawing.arrays[name], *SMALL[name]), by_row=SMALL[name][1] == "row")
        else:
            add(name, drawing.arrays[name].astype(np.float32))
    add("corners", drawing.corners.astype(np.uint16 if drawing.sizes["vertices"] < 2**16 else np.uint32))
    add("cells", drawing.cells.astype(np.uint16 if drawing.sizes["nodes"] < 2**16 else np.uint32))
    for name, values in motion_arrays(trained, drawing).items():
        add(name, values)
    header = {**describe(trained, drawing), "precision": precision, "arrays": entries}
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    raw = b"".join((FORMAT.encode(), len(text).to_bytes(4, "little"), text, *blocks))
    return WebFile(gzip.compress(raw, 9, mtime=0), drawing)


def quantised(values: np.ndarray, kind: str, column: str, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Integers and the scales of the columns, which run fastest; "row" keeps a scale for each first index."""
    shaped = {
        "all": lambda: values.reshape(-1, 1),
        "column": lambda: values.reshape(-1, values.shape[-1]),
        "last two": lambda: values.reshape(len(values), -1),
        "row": lambda: values.reshape(len(values), -1).T,
    }[column]()
    scales = np.maximum(np.abs(shaped).max(axis=0), 1e-12).astype(np.float64) / limit
    integers = np.rint(shaped / scales).astype(TYPES[kind])
    return (integers.T if column == "row" else integers), scales


def motion_arrays(trained: TrainedAvatar, drawing: WebArrays) -> dict[str, np.ndarray]:
    """The held-out frames' parameters [T, P] and head poses [T, 12], what the page plays."""
    recording = trained.recording
    chosen = recording.times(recording.split.test)[:MAX_MOTION]
    kept = list(drawing.kept)
    tracks = recording.tracks
    columns = [tracks["expression"][:, kept], *(tracks[name] for name in ("jaw", "eyes", "eyelids", "neck"))]
    params = torch.cat(columns, dim=1)[chosen].numpy()
    poses = torch.cat((tracks["R"].flatten(1), tracks["t"]), dim=1)[chosen].numpy()
    return {"motion": params.astype(np.float32), "poses": poses.astype(np.float32)}


def describe(trained: TrainedAvatar, drawing: WebArrays) -> dict[str, Any]:
    """What the page says, and how far things can be moved there."""
    recording, kept = trained.recording, list(drawing.kept)
    rest, camera = trained.rest_params(), front_camera(trained)
    names, turning = trained.assets.names.names, trained.avatar.turning
    return {
        "name": recording.name,
        "licence": licence_of(SKINNING),
        "sizes": drawing.sizes,
        "parents": list(drawing.parents),
        "fps": recording.fps,
        "blur": trained.config.model.blur,
        "head_rotation": None if turning is None else {"turning": turning.flatten().tolist(), "limit": LIMIT},
        "background": list(trained.config.data.background),
        "expressions": [names[i] if i < len(names) and names[i] else f"expression {i}" for i in kept],
        "controls": [
            {
                "group": control.part,
                "name": control.name,
                "values": [round(value, 6) for value in control.direction[kept].tolist()],
                "range": [control.low, control.high],
            }
            for control in trained.expression_controls()
        ],
        "drive": face_map(trained, kept),
        "joints": joint_ranges(recording.motion(recording.split.train)),
        "orbit": trained.orbit_limits(camera)._asdict(),
        "rest": torch.cat((rest.expression[kept], rest.jaw, rest.eyes, rest.eyelids, rest.neck)).tolist(),
        "camera": {
            "rotation": camera.R_cam_world.flatten().tolist(),
            "translation": camera.t_cam_world.tolist(),
            # How the head is turned, which stays when a camera of a rig moves around it; null: before this camera.
            "head": None if recording.rig is None else camera.head_rotation.flatten().tolist(),
            "fx": camera.fx / camera.width,
            "fy": camera.fy / camera.width,
            "cx": camera.cx / camera.width,
            "cy": camera.cy / camera.width,
            "aspect": camera.width / camera.height,
        },
        "size": camera.width,
    }
