from __future__ import annotations

import pytest

from avatar.config import config_dir, config_from_dict, load_config
from avatar.errors import UserError


@pytest.mark.parametrize("overrides", [["preset=paper"], ["experiment=paper"]])
def test_the_papers_recipe(overrides: list[str]) -> None:
    config = load_config(overrides)
    assert (config.model.latent_grid, config.trainer.initial_colours) == (None, "grey")
    assert (config.trainer.lr_warmup, config.trainer.lr_final) == (0, 1.0)
    assert (config.trainer.lpips_every, config.trainer.lpips_region) == (1, "frame")
    assert (config.model.name, config.model.latent_dim, config.model.uv_size) == ("hypergaussians", 8, 128)
    assert (config.model.mlp_width, config.model.mlp_layers, config.model.frequencies) == (256, 6, 8)
    rates = config.trainer.learning_rates
    assert (rates.sh_dc, rates.sh_rest, rates.opacity) == (2.5e-3, 2.5e-3 / 20, 0.05)
    assert (rates.scale, rates.rotation, rates.mlp, rates.hyper) == (5e-3, 1e-3, 1e-4, 1e-4)
    assert (config.trainer.iterations, config.trainer.perceptual_start, config.trainer.lpips_net) == (30000, 0.5, "vgg")
    assert config.data.background == (1.0, 1.0, 1.0)


def test_the_default_is_the_fast_preset_of_the_papers_model() -> None:
    config, paper = load_config(), load_config(["preset=paper"])
    assert config == load_config(["preset=fast"])
    assert config.model.latent_grid == 16 and config.trainer.initial_colours == "frames"
    assert (config.model.latent_dim, config.model.uv_size) == (paper.model.latent_dim, paper.model.uv_size)
    assert load_config(["preset=fast", "model.latent_grid=null"]).model.latent_grid is None


def test_later_overrides_win_and_survive_a_round_trip() -> None:
    config = load_config(["experiment=demo", "model=flashavatar", "trainer.iterations=7", "trainer.iterations=9"])
    assert config.trainer.iterations == 9
    assert (config.model.name, config.model.mlp_width) == ("flashavatar", 128)
    assert config_from_dict(config.to_dict()) == config


def test_a_configuration_says_where_it_computes() -> None:
    assert load_config([]).device == "auto" and load_config(["device=cuda:1"]).device == "cuda:1"
    older = load_config([]).to_dict()
    del older["device"]
    assert config_from_dict(older).device == "auto"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("modle=flashavatar", "no configuration key 'modle'; the nearest is 'model'"),
        ("trainer.iteration=3", "the nearest is 'trainer.iterations'"),
        ("iterations=3", "the nearest is 'trainer.iterations'"),
        ("model=flashavtar", "configs/model/ has flashavatar, hypergaussians"),
        ("trainer.iterations=many", "trainer.iterations is not valid: Value 'many' of type 'str'"),
        ("trainer.iterations=0", "trainer.iterations=0 is out of range"),
        ("trainer.iterations=null", "trainer.iterations is not valid"),
        ("trainer.perceptual=vgg", "not one of auto, lpips, dssim, none"),
        ("trainer.learning_rates.mlp=-1", "trainer.learning_rates.mlp=-1.0 is out of range"),
        ("trainer.learning_rates.mlp=nan", "trainer.learning_rates.mlp=nan is out of range"),
        ("model.latent_dim=0", "model.latent_dim=0 is out of range"),
        ("data.background=[1,2,3]", "three values from 0 to 1"),
        ("data.background=[1,2]", "data.background"),
        ("device=gpu", "device=gpu is not one of auto, cpu, cuda, cuda:N"),
        ("protocol=strict", "no configuration key 'protocol'"),
        ("size", "'size' is not of the form key=value"),
        ("trainer.iterations=[1", "cannot be composed"),
    ],
)
def test_a_wrong_override_gets_a_sentence(override: str, message: str) -> None:
    with pytest.raises(UserError) as caught:
        load_config([override])
    assert message in str(caught.value)


def test_every_key_in_the_yaml_files_has_a_comment() -> None:
    for file in sorted(config_dir().glob("*/*.yaml")):
        if file.parent.name in ("experiment", "preset", "protocol") or file.stem == "flashavatar":
            continue
        for line in file.read_text().splitlines():
            assert line.startswith(("#", "name: hyper")) or " # " in line, f"{file.name}: {line}"
