"""Gaussians between skin and skull: where the skull is, and the gradients of the shares."""

from __future__ import annotations

from dataclasses import replace

import torch
from heads import EXPRESSIONS, grid_head, random_params, rest_params
from torch import Tensor

from avatar.config import load_config
from avatar.gaussians.base_model import Avatar
from avatar.gaussians.skull_binding import INITIAL_LOGIT, SkullBinding, bind_to_skull
from avatar.runs.model_registry import make_avatar

SMALL = ["model.uv_size=24", "model.mlp_width=16", "model.mlp_layers=2", "model.skull_binding=true"]


def small_avatar() -> Avatar:
    """Shares from nearly none to nearly all; offsets that the expression moves."""
    avatar = make_avatar(grid_head(), torch.zeros(3), load_config(SMALL).model)
    assert avatar.skull_logits is not None and avatar.hyper is not None
    with torch.no_grad():
        avatar.skull_logits += 3.0 * torch.randn_like(avatar.skull_logits)
    return avatar


def test_at_rest_skin_and_skull_are_one() -> None:
    avatar = small_avatar()
    torch.testing.assert_close(avatar.points(avatar.vertices(rest_params())), avatar.skull, rtol=0, atol=1e-6)
    torch.testing.assert_close(avatar.skull, avatar.neutral_points())


def test_neither_face_nor_torso_moves_the_skull() -> None:
    avatar = small_avatar()
    assert avatar.skull_logits is not None
    params = random_params()
    with torch.no_grad():
        avatar.skull_logits.fill_(30.0)
    torch.testing.assert_close(avatar.points(avatar.vertices(params)), avatar.skull, rtol=0, atol=1e-7)
    with torch.no_grad():
        avatar.skull_logits.fill_(-30.0)
    points = avatar.points(avatar.vertices(params))
    torch.testing.assert_close(points, avatar.embedding.points(avatar.vertices(params)), rtol=0, atol=1e-7)
    for still in (replace(params, neck=rest_params().neck), replace(rest_params(), neck=params.neck)):
        assert (points - avatar.points(avatar.vertices(still))).abs().max() > 1e-3


def test_gradients_are_those_of_the_definition() -> None:
    generator = torch.Generator().manual_seed(0)
    points, skull, weights = (torch.randn(50, 3, generator=generator) for _ in range(3))
    logits = torch.randn(50, generator=generator)

    def gradients(function) -> tuple[Tensor, ...]:
        leaves = [t.clone().requires_grad_() for t in (points, logits)]
        return torch.autograd.grad((function(*leaves) * weights).sum(), leaves)

    def definition(points: Tensor, logits: Tensor) -> Tensor:
        w = 1 / (1 + torch.exp(-logits))[:, None]
        return (1 - w) * points + w * skull

    found = gradients(lambda points, logits: bind_to_skull(points, SkullBinding(skull, logits)))
    for own, expected in zip(found, gradients(definition), strict=True):
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
        assert not any("skull_logits" in name for name in avatar.state_dict())
        assert avatar(rest_params()).means.shape[1] == 3


def test_few_expression_coefficients_make_no_difference_to_the_skull() -> None:
    avatar = small_avatar()
    few = random_params(expressions=2)
    padded = replace(few, expression=torch.cat((few.expression, torch.zeros(EXPRESSIONS - 2))))
    for a, b in zip(avatar(few), avatar(padded), strict=True):
        torch.testing.assert_close(a, b)
