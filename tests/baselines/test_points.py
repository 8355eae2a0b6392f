"""Points that walk and sets that grow between the steps of a training."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from heads import grid_head
from small_runs import open_small, small_config, train_small

from avatar.baselines.monogaussianavatar import active_count, random_choice
from avatar.config import TrainerConfig
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.gaussians.encoding import positional_encoding
from avatar.runs.checkpoint import load_module, module_tensors, newest_checkpoint
from avatar.runs.model_registry import make_avatar
from avatar.runs.trained_avatar import load_avatar
from avatar.train.optimizer import make_optimizer
from avatar.types import HeadParams


def started(model: str) -> tuple[Avatar, torch.optim.Adam, TrainerConfig]:
    """An avatar after one optimizer step whose gradients are 1."""
    config = small_config("experiment=paper", f"model={model}", "trainer.iterations=100")
    avatar = make_avatar(grid_head(), torch.zeros(3), config.model)
    optimizer = make_optimizer(avatar, config.trainer)
    for parameter in avatar.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    return avatar, optimizer, config.trainer


def params() -> HeadParams:
    rest = torch.tensor([1.0, 0, 0, 0, 1, 0])
    return HeadParams(torch.zeros(3), rest, rest.repeat(2), torch.zeros(2), rest)


def test_a_set_grows_beside_what_is_seen_and_covers_as_much() -> None:
    avatar, optimizer, config = started("monogaussianavatar")
    points, N = avatar.mesh_points, len(avatar)
    alive = active_count(0, 100, N)
    assert int(avatar.count) == alive == len(avatar(params()).means) < N
    avatar.after_step(optimizer, 9, config)
    assert int(avatar.count) == alive
    with torch.no_grad():
        avatar.opacity_logits[:alive] = torch.linspace(0.0, 1.0, alive)  # each has a value of its own
        avatar.opacity_logits[3] = -20.0
        avatar.opacity_logits[alive:] = 99.0
    optimizer.state[avatar.quats]["exp_avg"][:alive] = torch.arange(alive)[:, None] + 1.0
    before, scales = avatar.opacity_logits.detach().clone(), avatar.log_scales.detach().clone()
    places = points.points(avatar.head.neutral_vertices())
    avatar.after_step(optimizer, 10, config)
    doubled = active_count(10, 100, N)
    assert int(avatar.count) == doubled == len(avatar(params()).means) >= 2 * alive

    born = torch.cat((torch.tensor([3]), torch.arange(alive, doubled)))
    others = torch.tensor([i for i in range(alive) if i != 3])
    assert torch.equal(avatar.opacity_logits[others], before[others])
    parents = torch.tensor([int((before[:alive] == value).nonzero()) for value in avatar.opacity_logits[born]])
    assert 3 not in parents and set(parents.tolist()) == set(others.tolist())  # all take part before one does twice
    shrunk = scales[others] - torch.log(torch.tensor(2.0)) / 2
    torch.testing.assert_close(avatar.log_scales[others], shrunk)
    torch.testing.assert_close(avatar.log_scales[born], avatar.log_scales[parents])
    torch.testing.assert_close(optimizer.state[avatar.quats]["exp_avg"][born, 0], parents + 1.0)
    assert torch.equal(avatar.opacity_logits[doubled:], before[doubled:])

    now = points.points(avatar.head.neutral_vertices())
    assert torch.equal(now[others], places[others])
    away = (now[born] - places[parents]).norm(dim=1) / avatar.log_scales[born].mean(dim=1).exp()
    assert 0.3 < float(away.median()) < 3.0 and float(away.max()) < 6.0
    torch.testing.assert_close(avatar.code, positional_encoding(now[:doubled]))


def test_growth_repeats_to_the_bit_and_another_seed_is_another_set() -> None:
    def grown(seed: int) -> torch.Tensor:
        torch.manual_seed(0)
        avatar, optimizer, config = started("monogaussianavatar")
        config.seed = seed
        avatar.after_step(optimizer, 10, config)
        return avatar.mesh_points.place

    assert torch.equal(grown(1), grown(1)) and not torch.equal(grown(1), grown(2))


def test_all_are_drawn_once_before_one_is_drawn_twice() -> None:
    found = random_choice(torch.tensor([4, 5, 6]), 7, torch.Generator().manual_seed(0)).tolist()
    assert len(found) == 7 and sorted(found[:3]) == sorted(found[3:6]) == [4, 5, 6] and found[6] in (4, 5, 6)


def test_what_is_transparent_throughout_does_not_stop_the_growth() -> None:
    avatar, optimizer, config = started("monogaussianavatar")
    with torch.no_grad():
        avatar.opacity_logits.fill_(-20.0)
    avatar.after_step(optimizer, 100, config)
    assert int(avatar.count) == len(avatar)


def test_places_walk_with_their_momentum_and_stay_on_the_mesh() -> None:
    avatar, optimizer, config = started("splattingavatar")
    points = avatar.mesh_points
    before = points.face.clone()
    with torch.no_grad():
        points.place[:, 0] += 0.004
    was = optimizer.state[points.place]["exp_avg"].clone()
    avatar.after_step(optimizer, 1, config)
    moved = points.face != before
    assert bool(moved.any()) and bool((points.barycentric() >= -1e-5).all())
    now = optimizer.state[points.place]["exp_avg"]
    assert torch.equal(now[~moved], was[~moved])
    turned = (now - was)[moved, :2].norm(dim=1)
    assert bool((turned > 1e-4).any()) and torch.equal(now[:, 2], was[:, 2])
    torch.testing.assert_close(now[moved].norm(dim=1), was[moved].norm(dim=1))


def test_the_default_has_neither() -> None:
    avatar, optimizer, config = started("hypergaussians")
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    avatar.after_step(optimizer, 50, config)
    assert all(torch.equal(value, before[name]) for name, value in avatar.state_dict().items())
    assert not any(name.startswith(("mesh_points", "count")) for name in before)


def test_a_run_whose_set_grew_is_opened_as_it_was_trained(tracked_folder: Path, tmp_path: Path) -> None:
    overrides = ["model=monogaussianavatar", "trainer.iterations=12"]
    avatar, _ = train_small(tracked_folder, tmp_path / "run", overrides)
    assert int(avatar.count) == len(avatar)
    trained = load_avatar(tmp_path / "run", tracked_folder / "head_model")
    assert torch.equal(trained.avatar.code, avatar.code)
    frame = trained.recording.params(0)
    torch.testing.assert_close(trained.avatar(frame).means, avatar(frame).means, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("model", "name", "value", "says"),
    [
        ("splattingavatar", "mesh_points.face", 10**6, "is damaged: it has points on triangles"),
        ("splattingavatar", "mesh_points.face", -1, "is damaged: it has points on triangles"),
        ("monogaussianavatar", "count", 10**6, "is damaged: it has 1000000 points alive of"),
        ("monogaussianavatar", "count", 0, "is damaged: it has 0 points alive of"),
    ],
)
def test_points_that_cannot_be_there_get_a_sentence(
    tracked_folder: Path, tmp_path: Path, model: str, name: str, value: int, says: str
) -> None:
    config = small_config(f"model={model}")
    _, subject, assets = open_small(tracked_folder, config)
    avatar = make_avatar(assets, subject.identity, config.model)
    tensors = module_tensors(avatar)
    tensors[f"model.{name}"] = torch.full_like(tensors[f"model.{name}"], value)
    with pytest.raises(UserError, match=says):
        load_module(avatar, tensors, tmp_path / "avatar.safetensors")
    with pytest.raises(UserError, match="holds no checkpoint"):
        newest_checkpoint(tmp_path)
