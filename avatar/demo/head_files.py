"""The demo head as files, in the form in which FLAME is handed out."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np

from avatar.demo.head import NUM_EXPRESSION, NUM_IDENTITY, PARENTS, DemoHead
from avatar.head.expression_names import NAMES_FILE

# What ARKit's blendshapes are on this head; those of one side are written for the left one.
_ARKIT: dict[str, dict[str, float]] = {
    "BrowDownLeft": {"brow_down_left": 1.0},
    "BrowInnerUp": {"brow_inner_up_left": 1.0, "brow_inner_up_right": 1.0},
    "BrowOuterUpLeft": {"brow_outer_up_left": 1.0},
    "CheekPuff": {"cheek_puff": 1.0},
    "CheekSquintLeft": {"cheek_up_left": 1.0},
    "EyeSquintLeft": {"squint_left": 1.0},
    "JawForward": {"jaw_back": -1.0},
    "MouthDimpleLeft": {"dimple_left": 1.0},
    "MouthFrownLeft": {"frown_left": 1.0},
    "MouthFunnel": {"funnel": 1.0},
    "MouthLeft": {"mouth_left": 1.0},
    "MouthRight": {"mouth_left": -1.0},
    "MouthLowerDownLeft": {"lower_lip_down_left": 1.0},
    "MouthPressLeft": {"lip_press": 0.5},
    "MouthPucker": {"pucker": 1.0},
    "MouthRollLower": {"lip_roll_in": 0.5},
    "MouthRollUpper": {"lip_roll_in": 0.5},
    "MouthShrugLower": {"chin_raise": 1.0},
    "MouthSmileLeft": {"smile_left": 1.0},
    "MouthStretchLeft": {"stretch_left": 1.0},
    "MouthUpperUpLeft": {"upper_lip_up_left": 1.0},
    "NoseSneerLeft": {"sneer_left": 1.0},
}


def write_head_model(folder: Path, head: DemoHead) -> None:
    """Write generic_model.pkl (plain numpy arrays), head_template.obj, the eyelids, FLAME_masks.pkl and the names of the
    expressions into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    V = len(head.template)
    shape_dirs = np.zeros((V, 3, NUM_IDENTITY + NUM_EXPRESSION), np.float32)
    shape_dirs[:, :, : head.identity_dirs.shape[2]] = head.identity_dirs
    shape_dirs[:, :, NUM_IDENTITY : NUM_IDENTITY + head.expression_dirs.shape[2]] = head.expression_dirs
    parents = np.array(PARENTS, np.int64)
    model = {
        "v_template": head.template,
        "f": head.mesh.faces.astype(np.uint32),
        "shapedirs": shape_dirs,
        "posedirs": head.pose_dirs,
        "J_regressor": head.joint_regressor,
        "weights": head.weights,
        "kintree_table": np.stack((parents, np.arange(len(parents)))).astype(np.uint32),
    }
    with (folder / "generic_model.pkl").open("wb") as file:
        pickle.dump(model, file, protocol=4)
    with (folder / "FLAME_masks.pkl").open("wb") as file:
        pickle.dump(dict(head.regions), file, protocol=4)
    for name, eyelid in zip(("l_eyelid.npy", "r_eyelid.npy"), head.eyelid_dirs, strict=True):
        np.save(folder / name, eyelid)
    lines = ["# procedural FLAME-format head, metres"]
    lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in head.template]
    lines += [f"vt {u:.7f} {v:.7f}" for u, v in head.mesh.uvs]
    corners = np.stack((head.mesh.faces, head.mesh.uv_faces), -1) + 1
    lines += ["f " + " ".join(f"{v}/{vt}" for v, vt in face) for face in corners]
    (folder / "head_template.obj").write_text("\n".join(lines) + "\n", encoding="ascii")
    names = {"names": head.expression_names, "arkit": _both_sides()}
    (folder / NAMES_FILE).write_text(json.dumps(names, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _both_sides() -> dict[str, dict[str, float]]:
    mirrored = {
        name.replace("Left", "Right"): {target.replace("_left", "_right"): w for target, w in own.items()}
        for name, own in _ARKIT.items()
        if name.endswith("Left") and name != "MouthLeft"
    }
    return _ARKIT | mirrored
