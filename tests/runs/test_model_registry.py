"""What every model gives to the rest of the program."""

from __future__ import annotations

from typing import get_args, get_type_hints

import pytest
import torch
from heads import grid_head, random_params
from small_runs import small_config

from avatar.config import ModelConfig
from avatar.runs.model_registry import MODELS, make_avatar


def test_the_models_are_those_of_the_configuration() -> None:
    assert set(MODELS) == set(get_args(get_type_hints(ModelConfig)["name"]))


@pytest.mark.parametrize("model", MODELS)
def test_each_parameter_has_one_learning_rate(model: str) -> None:
    config = small_config(f"model={model}")
    avatar = make_avatar(grid_head(), torch.zeros(3), config.model)
    groups = avatar.parameter_groups(config.trainer).values()
    grouped = [id(parameter) for parameters, rate in groups for parameter in parameters if rate > 0]
    assert sorted(grouped) == sorted(map(id, avatar.parameters()))


@pytest.mark.parametrize("model", MODELS)
def test_a_frozen_copy_leaves_the_avatar_as_it_is(model: str) -> None:
    avatar = make_avatar(grid_head(), torch.zeros(3), small_config(f"model={model}").model)
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    gaussians = avatar.frozen()(random_params())
    assert not any(field.requires_grad for field in gaussians)
    assert all(parameter.requires_grad for parameter in avatar.parameters())
    assert before.keys() == avatar.state_dict().keys()
    assert all(torch.equal(value, before[name]) for name, value in avatar.state_dict().items())
