"""The avatar's mesh for programs that know meshes: posed, with its expressions as morph targets and a baked texture."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from avatar.export.bake_texture import bake_texture
from avatar.head.normals import vertex_normals
from avatar.motion.controls import joint_ranges, joint_values, posed
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import HeadParams

NOTABLE = 0.2  # of a range, at its upper end: with less, training has not shown what the name says
LEAST = 1e-6  # metres: a target that moves nothing so far is left out
FLOAT = 5126  # of glTF


def encode_glb(trained: TrainedAvatar, params: HeadParams, size: int, licence: str) -> tuple[bytes, tuple[str, ...]]:
    """A glTF 2.0 binary and the names of its morph targets. Metres, y up, the face to +z, as glTF has it.

    Weight 1 of a target is as far as the training video shows, from the pose of the file.
    """
    assets = trained.assets
    corners = torch.stack((assets.faces.reshape(-1), assets.uv_faces.reshape(-1)), dim=1)
    unique, index = torch.unique(corners, dim=0, return_inverse=True)
    of_vertex, of_uv = unique.unbind(dim=1)
    base = trained.avatar.vertices(params)[: assets.num_vertices]
    image = Image.fromarray(bake_texture(trained, params, size))
    material = PBRMaterial(
        name=trained.name, baseColorTexture=image, metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True
    )
    mesh = trimesh.Trimesh(
        base[of_vertex].numpy(),
        index.reshape(-1, 3).numpy(),
        vertex_normals=vertex_normals(base, assets.faces)[of_vertex].numpy(),  # the same on both sides of a seam
        visual=TextureVisuals(uv=assets.uvs[of_uv].numpy(), material=material),
        process=False,
    )
    targets = {name: moved[of_vertex] for name, moved in offsets(trained, params).items()}
    targets = {name: moved for name, moved in targets.items() if float(moved.abs().max()) > LEAST}

    def add_targets(buffer_items: Any, tree: dict[str, Any]) -> None:
        (gltf_mesh,) = tree["meshes"]
        gltf_mesh["name"] = trained.name
        gltf_mesh["extras"] = {"targetNames": list(targets)}
        tree["asset"]["copyright"] = licence
        if targets:  # glTF allows no empty list of them
            gltf_mesh["primitives"][0]["targets"] = [
                {"POSITION": add_accessor(buffer_items, tree, name, moved)} for name, moved in targets.items()
            ]
            gltf_mesh["weights"] = [0.0] * len(targets)

    data = export_glb(trimesh.Scene(mesh), include_normals=True, buffer_postprocessor=add_targets)
    return data, tuple(targets)


def add_accessor(buffer_items: Any, tree: dict[str, Any], name: str, values: Float[Tensor, "T 3"]) -> int:
    """Append values to the file's buffer; the number of their accessor."""
    array = values.numpy().astype("<f4")
    buffer_items[f"target {name}"] = np.ascontiguousarray(array).tobytes()
    tree["accessors"][f"target {name}"] = {
        "bufferView": len(buffer_items) - 1,
        "componentType": FLOAT,
        "count": len(array),
        "type": "VEC3",
        "min": array.min(axis=0).tolist(),
        "max": array.max(axis=0).tolist(),
    }
    return len(tree["accessors"]) - 1


def offsets(trained: TrainedAvatar, params: HeadParams) -> dict[str, Float[Tensor, "V 3"]]:
    """How the mesh moves when one control or joint goes as far as the training video shows, and the others stay."""
    head, found = trained.avatar.head, {}
    start = head.vertices(params)
    for control in trained.expression_controls():
        far, ending = _end(control.low, control.high)
        own_share = float((params.expression - trained.neutral.expression) @ control.direction)
        moved = replace(params, expression=params.expression + (far - own_share) * control.direction)
        found[f"{control.part}: {control.name}{ending}"] = head.vertices(moved) - start
    own = {joint: float(value) for joint, value in joint_values([params]).items()}
    start = head.vertices(posed(params, None, own))
    for joint, (low, high) in joint_ranges(trained.recording.motion(trained.recording.split.train)).items():
        far, ending = _end(low, high)
        moved = posed(params, None, {**own, joint: far})
        found[joint.replace("_", " ") + ending] = head.vertices(moved) - start
    return found


def _end(low: float, high: float) -> tuple[float, str]:
    """How far a target goes, and what its name ends with: to where the name says, unless training hardly shows that."""
    return (high, "") if high >= NOTABLE * (high - low) else (low, " (reversed)")
