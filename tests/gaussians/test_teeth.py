"""Avatars with teeth: what they are bound to travels with them and is nobody's head model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lively import lively_avatar
from small_runs import new_avatar, open_small, small_config

from avatar.head.model import HeadModel
from avatar.head.teeth import GRID, ROWS
from avatar.runs.avatar_file import read_avatar_file, write_avatar_file
from avatar.runs.memory_estimate import count_gaussians
from avatar.runs.trained_avatar import TrainedAvatar, load_avatar

TEETH = "model.teeth=true"
PLAIN = "model.teeth=false"
COUNT = GRID[0] * GRID[1]  # vertices of a row


@pytest.fixture(scope="module")
def trained(open_mouth_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(open_mouth_folder, tmp_path_factory.mktemp("runs") / "run", TEETH)


def test_they_are_gaussians_more_and_the_head_stays(open_mouth_folder: Path) -> None:
    config, plain = small_config(TEETH), small_config(PLAIN)
    _, subject, assets = open_small(open_mouth_folder, config)
    avatar, without = new_avatar(assets, subject, config), new_avatar(assets, subject, plain)
    gaussians = count_gaussians(config.model, assets)
    assert gaussians == len(avatar) > len(without) == count_gaussians(plain.model, assets)
    shapes = {name: tuple(value.shape) for name, value in avatar.state_dict().items()}
    assert avatar.shapes(config.model, assets.num_expressions, gaussians) == shapes
    assert avatar.head.assets is assets and without.mesh is without.head
    assert avatar.mesh.assets.num_vertices == assets.num_vertices + len(ROWS) * COUNT
    params = subject.recording.params(3)
    V = assets.num_vertices
    assert torch.equal(without.vertices(params), avatar.head.vertices(params))
    torch.testing.assert_close(avatar.vertices(params)[:V], avatar.head.vertices(params), rtol=0, atol=1e-6)


def test_they_are_seen_and_move_with_the_head(trained: TrainedAvatar) -> None:
    """A picture without them is another one; the tracking's gradient reaches them."""
    params, camera = trained.rest_params(), trained.rest_camera(64)
    of_teeth = trained.avatar.embedding.texels.face >= len(trained.assets.faces)
    assert 0 < int(of_teeth.sum()) < len(of_teeth) // 2
    with torch.no_grad():
        whole = trained.avatar(params)
        hidden = whole._replace(opacities=torch.where(of_teeth, 0.0, whole.opacities))
        pictures = [trained.avatar.draw(g, camera, trained.background).image for g in (whole, hidden)]
    assert float((pictures[0] - pictures[1]).abs().max()) > 0.05
    jaw = params.jaw.clone().requires_grad_()
    vertices = trained.avatar.mesh.vertices(replace(params, jaw=jaw))
    upper, lower = vertices[trained.assets.num_vertices :].split(COUNT)
    (by_jaw,) = torch.autograd.grad(lower.square().sum(), jaw, retain_graph=True)
    assert float(by_jaw.abs().max()) > 1e-3
    (by_jaw,) = torch.autograd.grad(upper.square().sum(), jaw)
    assert float(by_jaw.abs().max()) < 1e-6


def test_a_packed_head_model_is_the_one_that_was_given(trained: TrainedAvatar, tmp_path: Path) -> None:
    packed = tmp_path / "packed.safetensors"
    content = read_avatar_file(trained.source)
    write_avatar_file(packed, replace(content, head=trained.assets))
    again = load_avatar(packed)
    assert again.assets.fingerprint == trained.assets.fingerprint == content.recording.head_fingerprint
    assert again.assets.num_vertices == trained.assets.num_vertices
    params = again.rest_params()
    assert torch.equal(again.avatar.vertices(params), trained.avatar.vertices(params))
    own = HeadModel(again.assets, again.recording.identity).vertices(params)
    torch.testing.assert_close(again.avatar.vertices(params)[: len(own)], own, rtol=0, atol=1e-6)
