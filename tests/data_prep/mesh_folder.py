"""Meshes of a known motion as INSTA's archives have them, written from the facts of that layout.

The head is posed here by FLAME's own formulas, one joint after the other, and written as Open3D does, with six digits.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from exports import shots

from avatar.head.assets import HeadAssets, load_head_assets

PARENT = {1: 0, 2: 1, 3: 1, 4: 1}


def matrix(six_d: np.ndarray) -> np.ndarray:
    first, second = six_d.reshape(2, 3)
    return np.stack((first, second, np.cross(first, second)))


def posed(head: HeadAssets, flame: dict[str, np.ndarray]) -> np.ndarray:
    """[V, 3] with root and neck at rest."""
    known = np.concatenate((flame["shape"], flame["exp"]))
    directions = np.concatenate((head.shape_dirs.numpy(), head.expression_dirs.numpy()), axis=2).astype(np.float64)
    shape = head.template.double().numpy() + directions @ known
    J = head.joint_regressor.double().numpy() @ shape
    turns = [np.eye(3), np.eye(3), *(matrix(v) for v in np.concatenate((flame["jaw"], flame["eyes"])).reshape(-1, 6))]
    shape = shape + head.pose_dirs.double().numpy() @ np.concatenate([(R - np.eye(3)).ravel() for R in turns[1:]])
    world = [(np.eye(3), np.zeros(3))]
    for joint, parent in PARENT.items():
        R, t = world[parent]
        world.append((R @ turns[joint], R @ (J[joint] - turns[joint] @ J[joint]) + t))
    weights = head.weights.double().numpy()
    vertices = sum(weights[:, j, None] * (shape @ R.T + t) for j, (R, t) in enumerate(world))
    return vertices + np.einsum("s,svc->vc", flame["eyelids"], head.eyelid_dirs.double().numpy())


class Topology:
    """Which of a head's faces and vertices its meshes keep: "full", "faces" left out, or "vertices" as well."""

    def __init__(self, head: HeadAssets, kind: str) -> None:
        faces, template = head.faces.numpy(), head.template.numpy()
        at_the_back = template[:, 2] < np.quantile(template[:, 2], 0.2)
        if kind != "full":
            faces = faces[~at_the_back[faces].all(axis=1)]
        self.rows = np.unique(faces) if kind == "vertices" else np.arange(head.num_vertices)
        self.faces = np.searchsorted(self.rows, faces)

    def write(self, path: Path, vertices: np.ndarray) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = ["# Created by Open3D", f"# number of vertices: {len(self.rows)}"]
        lines += [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in vertices[self.rows]]
        lines += [f"f {a} {b} {c}" for a, b, c in self.faces + 1]
        path.write_text("\n".join(lines) + "\n")


def write_meshes(tracked: Path, folder: Path, kind: str = "faces") -> None:
    """Of the small tracked folder; the canonical one is at rest, with an open mouth."""
    head = load_head_assets(tracked / "head_model")
    topology = Topology(head, kind)
    for shot in shots(tracked):
        topology.write(folder / "meshes" / f"{shot.frame_file.stem}.obj", posed(head, shot.flame))
        open_mouth = np.array([1, 0, 0, 0, np.cos(0.2), -np.sin(0.2)])
        rest = {"exp": np.zeros(head.num_expressions), "eyes": np.tile([1.0, 0, 0, 0, 1, 0], 2), "eyelids": np.zeros(2)}
        topology.write(folder / "canonical.obj", posed(head, {"shape": shot.flame["shape"], "jaw": open_mouth, **rest}))
