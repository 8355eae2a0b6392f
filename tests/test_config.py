from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, is_dataclass
from typing import get_args, get_type_hints

import pytest
import torch
from command_line import avatar

from avatar.config import (
    HYPER_RATE,
    NETWORK_RATE,
    OPACITY_RATE,
    Config,
    config_from_dict,
    declared_keys,
    flatten,
    load_config,
)
from avatar.config_values import Range
from avatar.errors import UserError
from avatar.gaussians.deformation import DeformationMLP
from avatar.gaussians.encoding import FREQUENCIES
from avatar.gaussians.uv_base_model import SH_DEGREE
from avatar.train.loss import perceptual_start


def test_the_papers_recipe() -> None:
    config = load_config(["experiment=paper"])
    assert (config.model.latent_grid, config.trainer.initialization) == (None, "grey")
    assert (config.trainer.lr_decay, config.trainer.sparse_lpips, config.trainer.perceptual) == (
        False,
        False,
        "lpips-vgg",
    )
    assert (config.model.name, config.model.latent_dim, config.model.uv_size) == ("hypergaussians", 8, 128)
    assert (config.model.mlp_width, config.model.mlp_layers, FREQUENCIES, SH_DEGREE) == (256, 6, 8, 3)
    rates = config.trainer.learning_rates
    assert (rates.sh_dc, rates.sh_rest, OPACITY_RATE) == (2.5e-3, 2.5e-3 / 20, 0.05)
    assert (rates.scale, rates.rotation, NETWORK_RATE, HYPER_RATE) == (5e-3, 1e-3, 1e-4, 1e-4)
    assert (config.trainer.iterations, perceptual_start(config.trainer)) == (30000, 15000)
    assert config.data.background == (1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("system", "differs"),
    [
        (["experiment=mlp_256x40"], {"model.name": "flashavatar", "model.mlp_layers": 40}),
        (["experiment=mlp_512x11"], {"model.name": "flashavatar", "model.mlp_width": 512, "model.mlp_layers": 11}),
        (["experiment=paper", "model=flashavatar"], {"model.name": "flashavatar"}),
        (["experiment=paper", "model=covariance"], {"model.name": "covariance"}),
        (["experiment=paper", "model=ndgs"], {"model.name": "ndgs"}),
        (["experiment=paper", "model=splattingavatar"], {"model.name": "splattingavatar"}),
        (["experiment=paper", "model=monogaussianavatar"], {"model.name": "monogaussianavatar"}),
    ],
)
def test_the_papers_systems_differ_in_what_the_paper_says_and_in_nothing_else(
    system: list[str], differs: dict[str, object]
) -> None:
    ours, paper = flatten(load_config(system).to_dict()), flatten(load_config(["experiment=paper"]).to_dict())
    assert {key: value for key, value in ours.items() if value != paper[key]} == differs


@pytest.mark.parametrize(("width", "layers", "published"), [(256, 6, "375K"), (256, 40, "2.6M"), (512, 11, "2.7M")])
def test_the_papers_networks_have_the_papers_sizes(width: int, layers: int, published: str) -> None:
    with torch.device("meta"):
        network = DeformationMLP(51, 120, 10, width, layers)
    count = sum(parameter.numel() for parameter in network.parameters())
    assert (f"{count // 1000}K" if count < 1e6 else f"{count / 1e6:.1f}M") == published


def test_paper_recipe_lacks_every_addition_of_the_default() -> None:
    ours, paper = flatten(load_config().to_dict()), flatten(load_config(["experiment=paper"]).to_dict())
    assert {key: (ours[key], paper[key]) for key in ours if ours[key] != paper[key]} == {
        "data.size": (None, 512),
        "model.uv_detail": (2, 1),
        "model.latent_grid": (8, None),
        "model.mlp_width": (128, 256),
        "model.initial_opacity": (0.3, 0.1),
        "model.blur": (0.05, 0.3),
        "model.skull_binding": (True, False),
        "model.head_rotation": (True, False),
        "model.teeth": (True, False),
        "trainer.iterations": (4000, 30000),
        "trainer.max_epochs": (10, None),
        "trainer.learning_rates.sh_dc": (1e-2, 2.5e-3),
        "trainer.learning_rates.sh_rest": (2.5e-3, 1.25e-4),
        "trainer.learning_rates.scale": (2e-2, 5e-3),
        "trainer.learning_rates.rotation": (4e-3, 1e-3),
        "trainer.lr_decay": (True, False),
        "trainer.initialization": ("frames", "grey"),
        "trainer.perceptual": ("auto", "lpips-vgg"),
        "trainer.sparse_lpips": (True, False),
        "trainer.dssim_weight": (0.2, 0.05),
        "trainer.dssim_early": (0.1, 0.0),
        "trainer.opposite_background_every": (3, None),
        "trainer.pose_rate": (0.01, 0.0),
        "trainer.condition_noise": (0.2, 0.0),
    }


def test_default_recipe_is_the_defaults_of_the_dataclasses() -> None:
    assert load_config() == Config() == load_config(["model=hypergaussians"])
    assert load_config(["experiment=paper", "model.latent_grid=8"]).model.latent_grid == 8


def test_iterations_lift_the_limit_of_passes() -> None:
    assert load_config().trainer.max_epochs == 10
    assert load_config(["trainer.iterations=7000"]).trainer.max_epochs is None
    assert load_config(["trainer.iterations=7000", "trainer.max_epochs=3"]).trainer.max_epochs == 3
    assert load_config(["trainer.max_epochs=3", "trainer.iterations=7000"]).trainer.max_epochs == 3


def test_later_overrides_win_and_survive_a_round_trip() -> None:
    config = load_config(["experiment=demo", "model=flashavatar", "trainer.iterations=7", "trainer.iterations=9"])
    assert config.trainer.iterations == 9
    assert (config.model.name, config.model.mlp_width) == ("flashavatar", 128)
    assert config_from_dict(config.to_dict()) == config


def test_a_configuration_says_where_it_computes() -> None:
    assert load_config([]).device == "auto" and load_config(["device=cuda:1"]).device == "cuda:1"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("modle=flashavatar", "no configuration key 'modle'; the nearest is 'model'"),
        ("trainer.iteration=3", "the nearest is 'trainer.iterations'"),
        ("iterations=3", "the nearest is 'trainer.iterations'"),
        (
            "model=flashavtar",
            "configs/model/ has covariance, flashavatar, gaussianheadavatar, gaussianheadavatar_hyper,",
        ),
        ("trainer.iterations=many", "trainer.iterations=many is not valid: it must be a whole number"),
        ("trainer.iterations=1.5", "trainer.iterations=1.5 is not valid: it must be a whole number"),
        ("trainer.iterations=true", "trainer.iterations=true is not valid: it must be a whole number"),
        ("trainer.iterations=1,2", "trainer.iterations=1,2 is not valid: it must be a whole number"),
        ("trainer.iterations=[1", "trainer.iterations=[1 is not valid: it must be a whole number"),
        ("trainer.iterations=null", "trainer.iterations=null is not valid: it must be a whole number"),
        ("data.size=big", "data.size=big is not valid: it must be a whole number, or null"),
        ("trainer.iterations=0", "trainer.iterations=0 is out of range: it must be from 1 to 99999999"),
        ("trainer.iterations=99999999999", "trainer.iterations=99999999999 is out of range"),
        ("model.initial_opacity=0", "model.initial_opacity=0 is out of range: it must be from 1e-06 to 0.999999"),
        ("model.initial_opacity=low", "model.initial_opacity=low is not valid: it must be a number"),
        ("trainer.dssim_weight=inf", "trainer.dssim_weight=inf is out of range: it must be from 0 to 1000000"),
        ("trainer.dssim_weight=1e400", "trainer.dssim_weight=inf is out of range"),
        (f"trainer.dssim_weight={10**400}", "trainer.dssim_weight=1e+300 is out of range"),
        (
            "trainer.perceptual=vgg",
            "trainer.perceptual=vgg is not one of auto, lpips-squeeze, lpips-vgg, lpips-alex, dssim, none",
        ),
        ("trainer.perceptual=null", "trainer.perceptual=null is not valid: it must be a word"),
        ("trainer.learning_rates.scale=-1", "trainer.learning_rates.scale=-1 is out of range: it must be from 0 to 10"),
        ("trainer.learning_rates.scale=nan", "trainer.learning_rates.scale=nan is out of range"),
        ("model.latent_dim=0", "model.latent_dim=0 is out of range"),
        ("data.background=[1,2,3]", "three numbers from 0 to 1"),
        ("data.background=[1,2]", "data.background=[1,2] is not valid: it must be a colour: white, black,"),
        ("data.background=purple", "data.background=purple is not valid: it must be a colour: white, black,"),
        ("data.background=#ff00", "data.background=#ff00 is not valid: it must be a colour"),
        ("data.background=", "data.background= is not valid: it must be a colour"),
        ("data.background=null", "data.background=null is not valid: it must be a colour"),
        ("preset=fast", "no configuration key 'preset'"),
        ("experiment=papr", "configs/experiment/ has demo, gha_paper, mlp_256x40, mlp_512x11, paper"),
        ("device=gpu", "device=gpu is not one of auto, cpu, cuda, cuda:N"),
        ("protocol=strict", "no configuration key 'protocol'"),
        ("trainer.learning_rates=1", "no configuration key 'trainer.learning_rates'"),
        ("size", "'size' is not of the form key=value"),
    ],
)
def test_a_wrong_override_gets_a_sentence(override: str, message: str) -> None:
    with pytest.raises(UserError) as caught:
        load_config([override])
    assert message in str(caught.value)


def declarations(schema: type = Config) -> Iterator[tuple[type, tuple[object, ...]]]:
    """The type of every key, and what else its annotation says."""
    for kind in get_type_hints(schema, include_extras=True).values():
        if is_dataclass(kind):
            yield from declarations(kind)  # type: ignore[arg-type]
        else:
            yield get_args(kind)[0], get_args(kind)[1:]


def test_every_number_has_a_range_with_both_ends() -> None:
    """What is accepted is what can work: checkpoints are named with eight digits."""
    numbers = [others for kind, others in declarations() if kind in (int, float, int | None)]
    ranges = [other for others in numbers for other in others if isinstance(other, Range)]
    assert len(ranges) == len(numbers) > 20
    assert all(-math.inf < limits.low < limits.high < math.inf for limits in ranges)


def test_every_key_says_in_the_help_of_train_what_it_does() -> None:
    keys, text = declared_keys(), avatar("train", "--help")
    assert keys.keys() == flatten(load_config().to_dict()).keys() and len(keys) <= 35
    assert all(meaning and f"{key}: {meaning} (default: " in text for key, meaning in keys.items())


@pytest.mark.parametrize(
    ("written", "colour"),
    [
        ("white", (1.0, 1.0, 1.0)),
        ("Green", (0.0, 1.0, 0.0)),
        ("#ff8000", (1.0, 128 / 255, 0.0)),
        ("'#0000FF'", (0.0, 0.0, 1.0)),
        ("[1,0.5,0]", (1.0, 0.5, 0.0)),
        ("1, 0.5, 0", (1.0, 0.5, 0.0)),
    ],
)
def test_a_background_may_be_written_as_people_write_colours(written: str, colour: tuple[float, ...]) -> None:
    config = load_config([f"data.background={written}"])
    assert config.data.background == colour and config_from_dict(config.to_dict()) == config


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("trainer.iterations=1e3", "trainer.iterations", 1000),
        ("trainer.iterations='5'", "trainer.iterations", 5),
        ("trainer.seed=010", "trainer.seed", 10),
        ("trainer.pose_rate=1", "trainer.pose_rate", 1.0),
        ("data.size=null", "data.size", None),
        ("data.size=~", "data.size", None),
        ("trainer.perceptual=none", "trainer.perceptual", "none"),
        ("data.test_cameras=01", "data.test_cameras", "01"),
        ("data.test_cameras='1e5'", "data.test_cameras", "1e5"),
        ("data.test_cameras=1_0", "data.test_cameras", "1_0"),
        ("data.test_cameras=Null", "data.test_cameras", None),
    ],
)
def test_a_value_is_read_as_it_is_meant(override: str, key: str, value: object) -> None:
    read = flatten(load_config([override]).to_dict())[key]
    assert read == value and type(read) is type(value)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda values: values.pop("model"), "the configuration lacks model"),
        (lambda values: values["trainer"].pop("seed"), "the configuration lacks trainer.seed"),
        (lambda values: values["model"].pop("teeth"), "the configuration lacks model.teeth"),
        (
            lambda values: values["trainer"].update(sed=1),
            "no configuration key 'trainer.sed'; the nearest is 'trainer.se",
        ),
        (lambda values: values.update(data=[1]), "the configuration has [1] where the keys data.* should be"),
        (lambda values: values["data"].update(background=7), "data.background=7 is not valid"),
    ],
)
def test_a_recorded_configuration_that_is_damaged_gets_a_sentence(damage, message: str) -> None:
    values = load_config().to_dict()
    damage(values)
    with pytest.raises(UserError) as caught:
        config_from_dict(values)
    assert message in str(caught.value)


def test_a_key_of_any_length_is_answered_in_a_short_sentence() -> None:
    with pytest.raises(UserError) as refused:
        config_from_dict({**asdict(load_config()), "x" * 20_000: 1})
    assert "there is no configuration key 'xxx" in str(refused.value) and len(str(refused.value)) < 300
