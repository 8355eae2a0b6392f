"""Gaussians that move as the mesh does before training has seen any picture."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from heads import grid_head, random_params, rest_params
from small_runs import new_avatar, open_small, small_config

from avatar.gaussianheadavatar import initial_motion
from avatar.gaussianheadavatar.initial_motion import HEADS, STEPS, MeshMotion, random_heads
from avatar.gaussianheadavatar.model import GaussianHeadAvatar
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.uv import bound_texels
from avatar.head.model import HeadModel
from avatar.train.trainer import initialize_from_frames


def test_points_of_the_mesh_move_with_it_and_others_with_the_nearest() -> None:
    assets = grid_head()
    head = HeadModel(assets, torch.zeros(3))
    mesh = Embedding(assets, bound_texels(assets, assets, 8, 1))
    rest = mesh.points(head.neutral_vertices())
    heads = [random_params(1), random_params(2)]
    target = MeshMotion(head, mesh, rest + 1e-5, heads)
    rows, which = torch.arange(len(rest)), torch.arange(len(rest)) % 2
    moves = torch.stack([mesh.points(head.vertices(params)) - rest for params in heads])
    torch.testing.assert_close(target(which, rows), moves[which, rows], rtol=0, atol=1e-6)


def test_random_heads_between_equal_frames_are_that_frame() -> None:
    same = random_params()
    for head in random_heads([same, same]):
        assert torch.equal(head.condition(), same.condition())


def test_random_heads_mix_jaw_expression_and_lids_of_different_frames_and_leave_the_neck_at_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(initial_motion, "HEADS", 200)
    monkeypatch.setattr(initial_motion, "SPREAD", 0.0)
    frames = [random_params(), rest_params()]
    heads = random_heads(frames)
    assert all(torch.equal(head.neck, frames[1].neck) for head in heads)
    drawn = torch.stack([torch.stack((head.jaw[1], head.expression[0], head.eyelids[0])) for head in heads])
    ends = torch.stack([torch.stack((head.jaw[1], head.expression[0], head.eyelids[0])) for head in frames])
    assert bool((drawn.amin(dim=0) < ends.amin(dim=0)).all()) and bool((drawn.amax(dim=0) > ends.amax(dim=0)).all())
    assert float(torch.corrcoef(drawn.T).triu(1).abs().max()) < 0.4


@pytest.mark.parametrize(
    "name",
    [
        "gaussianheadavatar_hyper",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("gaussianheadavatar", "gaussianheadavatar_ndgs")),
    ],
)
def test_gaussians_near_the_face_start_with_the_meshs_motion_at_expressions_of_no_frame(
    name: str, tracked_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(initial_motion, "STEPS", STEPS // 2)
    monkeypatch.setattr(initial_motion, "POINTS", 512)
    monkeypatch.setattr(initial_motion, "HEADS", HEADS)
    config = small_config(f"model={name}", "model.mlp_width=64")
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    assert isinstance(avatar, GaussianHeadAvatar)
    with torch.no_grad():
        avatar.networks.pose.deformation.layers[-1].bias += 1.0  # it decides between face and back
    initialize_from_frames(avatar, subject, config)
    mesh = Embedding(assets, bound_texels(assets, assets, config.model.uv_size, config.model.uv_detail))
    rows = torch.arange(len(mesh))[avatar.nearness()[: len(mesh)] > 0.0]
    frames = [subject.frame(index).params for index in subject.split.train]
    heads = random_heads(frames)[:4]
    target = MeshMotion(avatar.head, mesh, avatar.positions.detach()[rows], heads)
    moves = torch.stack([target(torch.full_like(rows, head), torch.arange(len(rows))) for head in range(len(heads))])
    gaussians = [avatar(params) for params in heads]
    errors = torch.stack([g.means.detach()[rows] for g in gaussians]) - avatar.positions.detach()[rows] - moves
    assert float(errors.norm()) < 0.5 * float(moves.norm())
    opacities = torch.stack([g.opacities.detach()[rows] for g in gaussians])
    at_rest = torch.sigmoid(avatar.opacity_logits.detach())[rows]
    assert bool((opacities > 0.6 * at_rest).all()), "the latent fades Gaussians"
