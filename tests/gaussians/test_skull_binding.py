"""Gaussians between skin and skull: where the skull is, and who learns of it."""

from __future__ import annotations

from dataclasses import replace

import torch
from heads import EXPRESSIONS, grid_head, random_params, rest_params
from torch import Tensor

from avatar.config import load_config
from avatar.gaussians.base_model import Avatar
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.skull_binding import INITIAL_LOGIT, Skull, SkullBinding, bind_to_skull
from avatar.gaussians.uv import uv_texels
from avatar.head.model import HeadModel, matrix_from_6d
from avatar.runs.model_registry import make_avatar

SMALL = ["model.uv_size=24", "model.mlp_width=16", "model.mlp_layers=2", "model.skull_binding=true"]


def parts() -> tuple[HeadModel, Embedding, Skull]:
    assets = grid_head()
    head = HeadModel(assets, torch.tensor([0.5, -0.3, 0.2]))
    embedding = Embedding(assets, uv_texels(assets, 20))
    return head, embedding, Skull.of(head, embedding)


def small_avatar() -> Avatar:
    """Shares from nearly none to nearly all; offsets that the expression moves."""
    avatar = make_avatar(grid_head(), torch.zeros(3), load_config(SMALL).model)
    assert avatar.skull_logits is not None and avatar.hyper is not None
    with torch.no_grad():
        avatar.skull_logits += 3.0 * torch.randn_like(avatar.skull_logits)
    return avatar


def test_at_rest_skin_and_skull_are_one() -> None:
    head, embedding, skull = parts()
    neutral = embedding.points(head.neutral_vertices())
    torch.testing.assert_close(skull.points(rest_params().neck), neutral, rtol=0, atol=1e-6)
    torch.testing.assert_close(embedding.points(head.vertices(rest_params())), neutral, rtol=0, atol=1e-6)


def test_the_skull_is_the_head_above_a_torso_that_the_neck_turns() -> None:
    """By linear blend skinning of the identity without correctives: what is not head turns about the neck's joint."""
    _, embedding, skull = parts()
    plain = replace(grid_head(), pose_dirs=torch.zeros(63, 3, 36))
    neck = random_params(4).neck
    turned = HeadModel(plain, torch.tensor([0.5, -0.3, 0.2])).vertices(replace(rest_params(), neck=neck))
    torch.testing.assert_close(skull.points(neck), embedding.points(turned), rtol=0, atol=1e-6)
    assert (skull.points(neck) - skull.at_rest).norm(dim=1).max() > 0.005


def test_the_skull_knows_nothing_of_the_face() -> None:
    avatar = small_avatar()
    assert avatar.skull is not None and avatar.skull_logits is not None
    with torch.no_grad():
        avatar.skull_logits.fill_(30.0)
    rest, face = rest_params(), replace(random_params(), neck=rest_params().neck)
    points = avatar.points(avatar.vertices(face), face)
    torch.testing.assert_close(points, avatar.skull.at_rest, rtol=0, atol=1e-7)
    with torch.no_grad():
        avatar.skull_logits.fill_(-30.0)
    points = avatar.points(avatar.vertices(face), face)
    torch.testing.assert_close(points, avatar.embedding.points(avatar.vertices(face)), rtol=0, atol=1e-7)
    assert (points - avatar.points(avatar.vertices(rest), rest)).abs().max() > 1e-3


def test_gradients_are_those_of_the_definition() -> None:
    head, embedding, skull = parts()
    generator = torch.Generator().manual_seed(0)
    params, N = random_params(2), len(embedding)
    weights = torch.randn(N, 3, generator=generator)
    logits = torch.randn(N, generator=generator)

    def gradients(function) -> tuple[Tensor, ...]:
        leaves = [t.clone().requires_grad_() for t in (params.neck, embedding.points(head.vertices(params)), logits)]
        return torch.autograd.grad((function(*leaves) * weights).sum(), leaves)

    def definition(neck: Tensor, points: Tensor, logits: Tensor) -> Tensor:
        joint, carried = head.neck()
        at_rest, carried = head.neutral_vertices(), carried[:, None]
        turned = joint + (at_rest - joint) @ matrix_from_6d(neck)
        w = 1 / (1 + torch.exp(-logits))[:, None]
        return (1 - w) * points + w * embedding.points(carried * at_rest + (1 - carried) * turned)

    found = gradients(lambda neck, points, logits: bind_to_skull(points, SkullBinding(skull, neck, logits)))
    for own, expected in zip(found, gradients(definition), strict=True):
        assert expected.abs().max() > 1e-3
        torch.testing.assert_close(own, expected, rtol=1e-4, atol=1e-5)


def test_an_avatar_begins_near_the_skin_and_learns_its_shares() -> None:
    avatar = make_avatar(grid_head(), torch.zeros(3), load_config(SMALL).model)
    assert avatar.skull_logits is not None
    assert torch.equal(avatar.skull_logits, torch.full((len(avatar),), INITIAL_LOGIT))
    gaussians = avatar(random_params())
    gaussians.means.square().sum().backward()
    assert avatar.skull_logits.grad is not None and (avatar.skull_logits.grad != 0).all()


def test_where_it_is_not_asked_for_nothing_is_learned() -> None:
    for overrides in (["model.skull_binding=false"], ["model=splattingavatar"], ["model=monogaussianavatar"]):
        avatar = make_avatar(grid_head(), torch.zeros(3), load_config([*SMALL, *overrides]).model)
        assert getattr(avatar, "skull", None) is None
        assert not any("skull_logits" in name for name in avatar.state_dict())
        assert avatar(rest_params()).means.shape[1] == 3


def test_few_expression_coefficients_make_no_difference_to_the_skull() -> None:
    avatar = small_avatar()
    few = random_params(expressions=2)
    padded = replace(few, expression=torch.cat((few.expression, torch.zeros(EXPRESSIONS - 2))))
    for a, b in zip(avatar(few), avatar(padded), strict=True):
        torch.testing.assert_close(a, b)
