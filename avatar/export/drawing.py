"""A trained avatar reduced to what drawing it takes: plain arrays, in the order that csrc/web/portrait.h names."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.errors import UserError
from avatar.gaussians.deformation import DeformationMLP
from avatar.head.assets import JOINT_NAMES, HeadAssets
from avatar.model import Avatar
from avatar.runs.trained import TrainedAvatar

# The arrays of csrc/web/portrait.h, in its order.
ARRAYS = (
    "shape",
    "expression_dirs",
    "pose_dirs",
    "weights",
    "eyelid_dirs",
    "joints_at_rest",
    "expression_joints",
    "barycentric",
    "of_code",
    "for_condition",
    "input_bias",
    "hidden_weights",
    "hidden_biases",
    "output_weights",
    "output_bias",
    "grid_weights",
    "head_matrix",
    "head_bias",
    "quats",
    "log_scales",
    "opacity_logits",
    "sh",
    "rigidity",
)


@dataclass(frozen=True)
class Drawing:
    """All that does not change from frame to frame, float32 and int32.

    Only the expression coefficients `kept` take part; the others were zero in all of the training video.
    """

    sizes: dict[str, int]  # of csrc/web/portrait.h, in its order
    arrays: dict[str, Float[np.ndarray, "..."]]  # of ARRAYS
    corners: Int[np.ndarray, "G 3"]
    cells: Int[np.ndarray, "G 4"]  # empty where the network is evaluated at every Gaussian
    parents: tuple[int, ...]
    kept: tuple[int, ...]


@torch.no_grad()
def reduce_avatar(trained: TrainedAvatar) -> Drawing:
    """Fold what can be folded, and leave out expression directions and vertices that nothing uses.

    Raises UserError for an avatar that does not fold.
    """
    model, assets = trained.avatar, trained.avatar.mesh.assets
    if model.ndgs is not None:
        raise UserError(
            "an avatar of model=ndgs cannot be exported for browsers, which do not know its opacities; train one with "
            "model=hypergaussians"
        )
    if model.mesh_points is not None or model.deformation is None:
        raise UserError(
            f"an avatar of model={model.config.name} cannot be exported for browsers, which do not know points that have "
            "left their texel; train one with model=hypergaussians"
        )
    moved = (trained.recording.tracks["expression"] != 0).any(dim=0).nonzero().flatten()
    used, corners = torch.unique(model.embedding.corners, return_inverse=True)
    arrays: dict[str, Tensor] = {
        **_head_arrays(model, assets, used, moved),
        "barycentric": model.embedding.barycentric,
        **_network_arrays(model, model.deformation, moved, assets.num_expressions),
        "quats": model.quats,
        "log_scales": model.log_scales,
        "opacity_logits": model.opacity_logits,
        "sh": torch.cat((model.sh_dc, model.sh_rest), dim=1),
        "rigidity": torch.zeros(0) if model.skull_shares is None else model.skull_shares,
    }
    grid = None if model.grid is None else model.grid.interpolate
    empty = torch.zeros(0)
    arrays["grid_weights"] = empty if grid is None else grid.weights
    folded = None if model.hyper is None else model.hyper.fold()
    arrays["head_matrix"], arrays["head_bias"] = (empty, empty) if folded is None else folded
    sizes = {
        "vertices": len(used),
        "expressions": len(moved),
        "gaussians": len(model),
        "nodes": len(model.code),
        "latent": model.deformation.output.out_features,
        "width": model.config.mlp_width,
        "layers": model.config.mlp_layers,
        "coefficients": arrays["sh"].shape[1],
        "has_grid": int(grid is not None),
        "has_heads": int(folded is not None),
        "has_rigidity": int(model.skull_shares is not None),
        "has_facing": int(model.turning is not None),
    }
    return Drawing(
        sizes,
        {name: np.ascontiguousarray(arrays[name].float().numpy()) for name in ARRAYS},
        corners.numpy().astype(np.int32),
        np.zeros((0, 4), np.int32) if grid is None else grid.cells.numpy().astype(np.int32),
        assets.parents,
        tuple(moved.tolist()),
    )


def _head_arrays(
    model: Avatar, assets: HeadAssets, used: Int[Tensor, " v"], moved: Int[Tensor, " e"]
) -> dict[str, Tensor]:
    """Skinning of the vertices that Gaussians are bound to; joints with the expressions folded in."""
    identity = model.mesh.neutral_vertices()
    directions = assets.expression_dirs[:, :, moved]
    expression_joints = torch.einsum("jv,vce->ejc", assets.joint_regressor, directions)
    pose_dirs = assets.pose_dirs.reshape(len(assets.template), 3, 9 * (len(JOINT_NAMES) - 1))
    return {
        "shape": identity[used],
        "expression_dirs": directions[used].permute(2, 0, 1),
        "pose_dirs": pose_dirs[used].permute(2, 0, 1),
        "weights": assets.weights[used],
        "eyelid_dirs": assets.eyelid_dirs[:, used],
        "joints_at_rest": assets.joint_regressor @ identity,
        "expression_joints": expression_joints,
    }


def _network_arrays(
    model: Avatar, network: DeformationMLP, moved: Int[Tensor, " e"], expressions: int
) -> dict[str, Tensor]:
    """The deformation network with the first layer's product with the positional code done."""
    for_code, for_condition = network.input.weight.split((network.code_size, network.condition_size), dim=1)
    conditions = torch.cat((moved, torch.arange(expressions, network.condition_size)))
    return {
        "of_code": model.code @ for_code.T,
        "for_condition": for_condition[:, conditions].T,
        "input_bias": network.input.bias,
        "hidden_weights": torch.cat([torch.zeros(0), *(layer.weight.T.reshape(-1) for layer in network.hidden)]),  # type: ignore[union-attr]
        "hidden_biases": torch.cat([torch.zeros(0), *(layer.bias for layer in network.hidden)]),  # type: ignore[union-attr]
        "output_weights": network.output.weight.T,
        "output_bias": network.output.bias,
    }
