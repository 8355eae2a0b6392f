"""A trained avatar reduced to what drawing it takes: plain arrays, in the order that csrc/web/web_avatar.h names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.errors import UserError
from avatar.export.default_view import with_faded_neck
from avatar.gaussians.deformation import FoldedNetwork
from avatar.head.assets import JOINT_NAMES, HeadAssets
from avatar.model import FlashAvatar
from avatar.runs.trained_avatar import TrainedAvatar

# The arrays of csrc/web/web_avatar.h, in its order.
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
    "skull_share",
)
LEAST_ALPHA = 1 / 255  # what is drawn at all


@dataclass(frozen=True)
class WebArrays:
    """All that does not change from frame to frame, float32 and int32.

    Only the expression coefficients `kept` take part; the others were zero in all of the training video.
    """

    sizes: dict[str, int]  # of csrc/web/web_avatar.h, in its order
    arrays: dict[str, Float[np.ndarray, "..."]]  # of ARRAYS
    corners: Int[np.ndarray, "G 3"]
    cells: Int[np.ndarray, "C 4"]  # empty where the network is evaluated at every Gaussian
    parents: tuple[int, ...]
    kept: tuple[int, ...]


@torch.no_grad()
def reduce_avatar(trained: TrainedAvatar) -> WebArrays:
    """Fold what can be folded, fade the neck, and leave out Gaussians that are too faint to be seen, and expression
    directions and vertices that nothing uses.

    Raises UserError for an avatar that does not fold.
    """
    if (unknown := trained.avatar.unknown_to_browsers) is not None:
        raise UserError(
            f"an avatar of model={trained.config.model.name} cannot be exported for browsers, which do not know {unknown}; "
            "train one with model=hypergaussians"
        )
    model = cast(FlashAvatar, with_faded_neck(trained).avatar)
    assets = model.mesh.assets
    moved = (trained.recording.tracks["expression"] != 0).any(dim=0).nonzero().flatten()
    seen = (torch.sigmoid(model.opacity_logits) >= LEAST_ALPHA).nonzero().flatten()
    used, corners = torch.unique(model.embedding.corners[seen], return_inverse=True)
    grid, empty = model.grid, torch.zeros(0)
    network = _network_arrays(model, moved, assets.num_expressions)
    if grid is None:
        network["of_code"] = network["of_code"][seen]
    folded = None if model.hyper is None else model.hyper.fold()
    arrays: dict[str, Tensor] = {
        **_head_arrays(model, assets, used, moved),
        "barycentric": model.embedding.barycentric[seen],
        **network,
        "grid_weights": empty if grid is None else grid.weights[seen],
        "head_matrix": empty if folded is None else folded.matrix[seen],
        "head_bias": empty if folded is None else folded.bias[seen],
        "quats": torch.nn.functional.normalize(model.quats[seen], dim=1),  # a short one would be rounded to zero
        "log_scales": model.log_scales[seen],
        "opacity_logits": model.opacity_logits[seen],
        "sh": torch.cat((model.sh_dc, model.sh_rest), dim=1)[seen],
        "skull_share": empty if model.skull_logits is None else torch.sigmoid(model.skull_logits[seen]),
    }
    sizes = {
        "vertices": len(used),
        "expressions": len(moved),
        "gaussians": len(seen),
        "nodes": len(network["of_code"]),
        "latent": model.deformation.output.out_features,
        "width": model.config.mlp_width,
        "layers": model.config.mlp_layers,
        "coefficients": arrays["sh"].shape[1],
        "has_grid": int(grid is not None),
        "has_heads": int(folded is not None),
        "has_skull_binding": int(model.skull_logits is not None),
        "has_head_rotation": int(model.turning is not None),
    }
    return WebArrays(
        sizes,
        {name: np.ascontiguousarray(arrays[name].float().numpy()) for name in ARRAYS},
        corners.numpy().astype(np.int32),
        np.zeros((0, 4), np.int32) if grid is None else grid.cells[seen].numpy().astype(np.int32),
        assets.parents,
        tuple(moved.tolist()),
    )


def _head_arrays(
    model: FlashAvatar, assets: HeadAssets, used: Int[Tensor, " v"], moved: Int[Tensor, " e"]
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


def _network_arrays(model: FlashAvatar, moved: Int[Tensor, " e"], expressions: int) -> dict[str, Tensor]:
    """The deformation network with the first layer's product with the positional code done."""
    network = FoldedNetwork(model.deformation, model.code)
    conditions = torch.cat((moved, torch.arange(expressions, network.for_condition.shape[1])))
    *hidden, (output_weights, output_bias) = network.layers
    return {
        "of_code": network.of_code,
        "for_condition": network.for_condition[:, conditions].T,
        "input_bias": network.bias,
        "hidden_weights": torch.cat([torch.zeros(0), *(weight.reshape(-1) for weight, _ in hidden)]),
        "hidden_biases": torch.cat([torch.zeros(0), *(bias for _, bias in hidden)]),
        "output_weights": output_weights,
        "output_bias": output_bias,
    }
