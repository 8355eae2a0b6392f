"""The demo head as files, in the form in which FLAME is handed out."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from avatar.demo.head import NUM_EXPRESSION, NUM_IDENTITY, PARENTS, DemoHead


def write_head_model(folder: Path, head: DemoHead) -> None:
    """Write generic_model.pkl (plain numpy arrays), head_template.obj, the eyelids and FLAME_masks.pkl into `folder`."""
    folder.mkdir(parents=True)
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
