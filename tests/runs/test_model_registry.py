"""What every model gives to the rest of the program."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import torch
from heads import grid_head, random_params
from small_runs import small_config
from tracked_folder import write_head_model

from avatar.config import LearningRates, ModelConfig, TrainerConfig, declared_keys
from avatar.runs.model_registry import MODELS, keys_without_effect, make_avatar


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


@pytest.mark.parametrize("model", MODELS)
def test_keys_without_effect_are_all_that_change_nothing(model: str, tmp_path: Path) -> None:
    assets = write_head_model(tmp_path, mouth_opening=True)
    config = small_config(f"model={model}").model
    other = {"latent_dim": 5, "latent_grid": 2, "mlp_width": 40, "mlp_layers": 5, "upsampling": 4}
    other |= {key: not getattr(config, key) for key in ("skull_binding", "head_rotation", "teeth")}

    def parts(config: ModelConfig) -> object:
        count = MODELS[model].count_gaussians(config, assets)
        return MODELS[model].shapes(config, assets.num_expressions, count), MODELS[model].most_places(config, count)

    same = {key for key, value in other.items() if parts(replace(config, **{key: value})) == parts(config)}
    assert same == set(MODELS[model].without_effect)
    overrides = [f"model={model}", *(f"model.{key}={value}" for key, value in other.items())]
    assert keys_without_effect(overrides, model) == [f"model.{key}" for key in other if key in same]


@pytest.mark.parametrize("model", MODELS)
def test_keys_of_the_training_that_change_nothing_are_named(model: str) -> None:
    config = small_config(f"model={model}")
    avatar = make_avatar(grid_head(), torch.zeros(3), config.model)

    def rates(trainer: TrainerConfig) -> list[float]:
        return [rate for _, rate in avatar.parameter_groups(trainer).values()]

    rate_names = [field.name for field in fields(LearningRates)]
    others = {name: replace(config.trainer.learning_rates, **{name: 0.5}) for name in rate_names}
    alike = [
        name
        for name, own in others.items()
        if rates(replace(config.trainer, learning_rates=own)) == rates(config.trainer)
    ]
    expected = [f"trainer.learning_rates.{name}" for name in alike]
    expected += [] if avatar.has_colours else ["trainer.opposite_background_every"]
    with torch.no_grad():  # what is new does not follow the expression
        for parameter in avatar.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    params = random_params()
    noisy, vertices = params.with_condition(params.condition() + 1.0), avatar.vertices(params)
    if all(torch.equal(a, b) for a, b in zip(avatar(params, vertices), avatar(noisy, vertices), strict=True)):
        expected.append("trainer.condition_noise")
    named = keys_without_effect([f"{key}=1" for key in declared_keys()], model)
    assert sorted(key for key in named if key.startswith("trainer.")) == sorted(expected)
