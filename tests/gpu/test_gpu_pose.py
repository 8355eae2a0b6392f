"""Posing of the head: the kernels against `HeadModel.vertices`."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from heads import grid_head, random_params, rest_params
from interpreter import DEVICE, error, the_cpus_way

from avatar.config import load_config
from avatar.head.model import HeadModel
from avatar.runs.model_registry import make_avatar

HEAD = HeadModel(grid_head(rows=13, columns=11), 0.5 * torch.randn(20, generator=torch.Generator().manual_seed(2)))


@pytest.mark.parametrize("expressions", [5, 3, 1])
@pytest.mark.parametrize("seed", [0, 1])
def test_vertices_are_those_of_the_head_model(seed: int, expressions: int) -> None:
    from avatar.head.pose_gpu import pose_gpu

    params = random_params(seed, expressions)
    tensors = HEAD.pose_tensors(DEVICE)
    assert tensors is not None
    assert error(pose_gpu(tensors, params.to(DEVICE)), HEAD.vertices(params)) < 1e-6


def test_at_rest_nothing_moves() -> None:
    from avatar.head.pose_gpu import pose_gpu

    tensors = HEAD.pose_tensors(DEVICE)
    assert tensors is not None
    assert error(pose_gpu(tensors, rest_params().to(DEVICE)), HEAD.neutral_vertices()) < 1e-6


def test_a_head_whose_joints_hang_together_otherwise_is_posed_on_the_cpu() -> None:
    assets = replace(grid_head(), parents=(-1, 0, 1, 2, 2))
    avatar = make_avatar(assets, torch.zeros(3), load_config(["model.uv_size=12", "model.mlp_width=8"]).model).to(
        DEVICE
    )
    params = random_params()
    with the_cpus_way():
        expected = avatar.head.vertices(params)
    found = avatar.vertices(params)
    assert found.device.type == DEVICE.type and torch.equal(found.cpu(), expected)
