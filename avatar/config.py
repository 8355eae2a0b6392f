"""The configuration: YAML files under configs/ and `key=value` overrides in, typed dataclasses out.

Hydra composes; defaults and what the keys mean stand in the YAML files, the dataclasses below are the schema: an unknown
key, a wrong type or a value outside its range is refused with a sentence that names the key and the nearest one.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, get_type_hints

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from avatar.config_values import (
    cause,
    check_choice,
    check_device,
    check_range,
    checked_value,
    config_dir,
    shown,
    typed_value,
)
from avatar.data.background import Colour
from avatar.errors import UserError


@dataclass
class DataConfig:
    """How the prepared subject is read."""

    size: int | None
    background: Colour
    train_frames: int | None
    test_frames: int | None
    cache_mb: int
    workers: int


@dataclass
class ModelConfig:
    """The avatar's architecture; the checkpoint holds it, and it cannot change afterwards."""

    name: str
    uv_size: int
    latent_dim: int
    latent_grid: int | None
    mlp_width: int
    mlp_layers: int
    frequencies: int
    sh_degree: int
    initial_opacity: float
    uv_detail: int
    rigidity: bool = False  # avatars that lack it were made without
    blur: float = 0.3  # with which those that lack it were trained
    facing: bool = False
    teeth: bool = False


@dataclass
class LearningRates:
    """Adam's learning rate of each group of parameters."""

    sh_dc: float
    sh_rest: float
    opacity: float
    scale: float
    rotation: float
    mlp: float
    hyper: float


@dataclass
class TrainerConfig:
    """The optimisation."""

    iterations: int
    passes: int | None
    seed: int
    learning_rates: LearningRates
    lr_warmup: int
    lr_final: float
    adam_eps: float
    initial_colours: str
    sh_interval: int
    huber_delta: float
    mouth_weight: float
    perceptual: str
    perceptual_weight: float
    dssim_weight: float
    dssim_early: float
    perceptual_start: float
    lpips_net: str
    lpips_every: int
    lpips_region: str
    log_every: int
    preview_every: int
    checkpoint_every: int
    keep_checkpoints: int
    stray_share: float = 0.0  # runs that lack it were made without, as those that lack one of the next
    align_rate: float = 0.0
    condition_noise: float = 0.0


@dataclass
class Config:
    """Everything that decides the result of a training run, apart from its input."""

    data: DataConfig
    model: ModelConfig
    trainer: TrainerConfig
    device: str

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


MAX_OVERRIDE = 1000  # characters; a message quotes the override
MOST_STEPS = 99_999_999  # checkpoints are named with eight digits
PROTOCOLS = "protocol"  # the folder of configs/ that holds evaluation protocols; no part of a configuration

CHOICES: dict[str, tuple[str, ...]] = {
    "model.name": ("hypergaussians", "flashavatar", "covariance", "ndgs", "splattingavatar", "monogaussianavatar"),
    "trainer.perceptual": ("auto", "lpips", "dssim", "none"),
    "trainer.lpips_net": ("vgg", "alex", "squeeze"),
    "trainer.lpips_region": ("frame", "head"),
    "trainer.initial_colours": ("grey", "frames"),
}
RANGES: dict[str, tuple[float, float]] = {
    "data.size": (16, 8192),
    "data.train_frames": (1, MOST_STEPS),
    "data.test_frames": (1, MOST_STEPS),
    "data.cache_mb": (1, 2**20),
    "data.workers": (1, 64),
    "model.uv_size": (2, 2048),
    "model.uv_detail": (1, 8),
    "model.latent_dim": (1, 4096),
    "model.latent_grid": (1, 2048),
    "model.mlp_width": (1, 65536),
    "model.mlp_layers": (1, 1000),
    "model.frequencies": (0, 30),
    "model.sh_degree": (0, 3),
    "model.initial_opacity": (1e-6, 1 - 1e-6),
    "model.blur": (0, 100),
    "trainer.iterations": (1, MOST_STEPS),
    "trainer.passes": (1, MOST_STEPS),
    "trainer.seed": (0, 2**31 - 1),
    "trainer.lr_warmup": (0, MOST_STEPS),
    "trainer.adam_eps": (1e-20, 1),  # float32 has no squares of gradients below 1e-21: less would not bound their steps
    "trainer.sh_interval": (1, MOST_STEPS),
    "trainer.huber_delta": (1e-6, 1000),
    "trainer.mouth_weight": (0, 10**6),
    "trainer.perceptual_weight": (0, 10**6),
    "trainer.dssim_weight": (0, 10**6),
    "trainer.dssim_early": (0, 10**6),
    "trainer.lpips_every": (1, MOST_STEPS),
    "trainer.log_every": (1, MOST_STEPS),
    "trainer.preview_every": (1, MOST_STEPS),
    "trainer.checkpoint_every": (1, MOST_STEPS),
    "trainer.keep_checkpoints": (1, 10**6),
}
_SHARES = "lr_final", "perceptual_start", "stray_share", "align_rate", "condition_noise"
RANGES |= {f"trainer.{name}": (0, 1) for name in _SHARES}
RANGES |= {f"trainer.learning_rates.{f.name}": (0.0, 10.0) for f in dataclasses.fields(LearningRates)}


def load_config(overrides: Sequence[str] = ()) -> Config:
    """Compose configs/config.yaml with `key=value` or `group=option` overrides, later ones winning.

    `trainer.iterations` without `trainer.passes` lifts a preset's limit of passes over the frames.
    Raises UserError for an unknown key or option, a wrong type or a value out of range.
    """
    values: dict[str, Any] = OmegaConf.to_container(_composed(overrides), resolve=True)  # type: ignore[assignment]
    given = dict(override.split("=", 1) for override in overrides if override.partition("=")[0] not in _groups())
    for key, text in given.items():
        *sections, name = key.split(".")
        reduce(dict.__getitem__, sections, values)[name] = typed_value(text)
    if "trainer.iterations" in given and "trainer.passes" not in given:
        values["trainer"]["passes"] = None
    return config_from_dict(values)


def chosen_options(overrides: Sequence[str] = ()) -> dict[str, str]:
    """The option of each group, such as {"model": "hypergaussians", "preset": "fast"}; raises as `load_config` does."""
    choices = _composed(overrides, hydra=True).hydra.runtime.choices
    return {group: option for group, option in choices.items() if group in _groups()}


def _composed(overrides: Sequence[str], hydra: bool = False) -> DictConfig:
    """The files of configs/ with the chosen options; what else is overridden has only been checked for its key."""
    if long := next((override for override in overrides if len(override) > MAX_OVERRIDE), None):
        raise UserError(f"the override {long[:60]}... has {len(long)} characters; no value of a key needs that many")
    _check_overrides(overrides)
    chosen = [override for override in overrides if override.partition("=")[0] in _groups()]
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            return compose("config", overrides=chosen, return_hydra_config=hydra)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(f"the configuration cannot be composed: {cause(error)}") from None


def config_from_dict(values: dict[str, Any]) -> Config:
    """A checked Config from nested dictionaries, as a checkpoint or a composed YAML holds them.

    Raises UserError for keys that are missing or unknown, wrong types and values out of range.
    """
    config = _section(values, Config, "")
    assert isinstance(config, Config)
    flat = flatten(config.to_dict())
    for key, choices in CHOICES.items():
        check_choice(key, flat[key], choices)
    for key, (low, high) in RANGES.items():
        check_range(key, flat[key], low, high)
    check_device(config.device)
    return config


def _section(values: Any, schema: type, prefix: str) -> Any:
    """The dataclass `schema` of a dictionary; `prefix` is what its keys are called by."""
    if not isinstance(values, dict):
        raise UserError(f"the configuration has {shown(values)} where the keys {prefix}* should be")
    kinds = get_type_hints(schema)
    if unknown := [key for key in values if key not in kinds]:
        raise _no_such_key(f"{prefix}{unknown[0]}")
    values = {f.name: f.default for f in dataclasses.fields(schema) if f.default is not dataclasses.MISSING} | values
    if missing := [key for key in kinds if key not in values]:
        raise UserError(f"the configuration lacks {prefix}{missing[0]}")
    return schema(
        **{
            name: _section(values[name], kind, f"{prefix}{name}.")
            if isinstance(kind, type) and dataclasses.is_dataclass(kind)
            else checked_value(f"{prefix}{name}", values[name], kind)
            for name, kind in kinds.items()
        }
    )


def _check_overrides(overrides: Sequence[str]) -> None:
    groups, keys = _groups(), _known_keys()
    for override in overrides:
        key, separator, value = override.partition("=")
        if not separator or not key:
            raise UserError(f"'{shown(override)}' is not of the form key=value")
        if key in groups:
            if value not in groups[key]:
                raise UserError(
                    f"{key}={shown(value)}: there is no such file; configs/{key}/ has {', '.join(groups[key])}"
                )
        elif key not in keys:
            raise _no_such_key(key, list(groups))


def _no_such_key(key: str, groups: Sequence[str] = ()) -> UserError:
    return UserError(f"there is no configuration key '{shown(key)}'{_nearest_hint(shown(key), groups)}")


def _groups() -> dict[str, list[str]]:
    """The options of each group of configs/."""
    folders = [p for p in config_dir().iterdir() if p.is_dir() and p.name != PROTOCOLS]
    return {p.name: sorted(f.stem for f in p.glob("*.yaml")) for p in folders}


def _known_keys(schema: type = Config, prefix: str = "") -> list[str]:
    keys: list[str] = []
    for name, kind in get_type_hints(schema).items():
        keys += (
            _known_keys(kind, f"{prefix}{name}.")
            if isinstance(kind, type) and dataclasses.is_dataclass(kind)
            else [f"{prefix}{name}"]
        )
    return keys


def _nearest_hint(key: str, groups: Sequence[str] = ()) -> str:
    known = [*_known_keys(), *groups]
    by_last = {name.rsplit(".", 1)[-1]: name for name in known}
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    near = near or [by_last[m] for m in difflib.get_close_matches(key.rsplit(".", 1)[-1], list(by_last), n=1)]
    return f"; the nearest is '{near[0]}'" if near else ""


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dictionaries as one, with keys as they are written in overrides: `trainer.learning_rates.mlp`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
