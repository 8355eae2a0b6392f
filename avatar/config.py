"""The configuration: YAML files under configs/ and `key=value` overrides in, typed dataclasses out.

Hydra composes (groups `data`, `model`, `trainer`, `preset`, `experiment`); the defaults and what each key means stand in
the YAML files, the dataclasses below are the schema: an unknown key, a wrong type or a value outside its range is refused
with a sentence that names the key and the nearest one that exists.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from avatar.errors import UserError


@dataclass
class DataConfig:
    """How the prepared subject is read."""

    size: int | None
    background: tuple[float, float, float]
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
    perceptual_start: float
    lpips_net: str
    lpips_every: int
    lpips_region: str
    log_every: int
    preview_every: int
    checkpoint_every: int
    keep_checkpoints: int


@dataclass
class Config:
    """Everything that decides the result of a training run, apart from its input."""

    data: DataConfig
    model: ModelConfig
    trainer: TrainerConfig
    device: str = "auto"  # files of earlier versions do not say

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


MAX_OVERRIDE = 1000  # characters; a message quotes the override
PROTOCOLS = "protocol"  # the folder of configs/ that holds evaluation protocols; no part of a configuration

DEVICE = re.compile(r"auto|cpu|cuda(:[0-9]{1,3})?")
CHOICES: dict[str, tuple[str, ...]] = {
    "model.name": ("hypergaussians", "flashavatar"),
    "trainer.perceptual": ("auto", "lpips", "dssim", "none"),
    "trainer.lpips_net": ("vgg", "alex", "squeeze"),
    "trainer.lpips_region": ("frame", "head"),
    "trainer.initial_colours": ("grey", "frames"),
}
RANGES: dict[str, tuple[float, float]] = {
    "data.size": (16, 8192),
    "data.train_frames": (1, math.inf),
    "data.test_frames": (1, math.inf),
    "data.cache_mb": (1, math.inf),
    "data.workers": (1, 64),
    "model.uv_size": (2, 2048),
    "model.latent_dim": (1, 4096),
    "model.latent_grid": (1, 2048),
    "model.mlp_width": (1, 65536),
    "model.mlp_layers": (1, 1000),
    "model.frequencies": (0, 30),
    "model.sh_degree": (0, 3),
    "model.initial_opacity": (1e-6, 1 - 1e-6),
    "trainer.iterations": (1, math.inf),
    "trainer.seed": (0, 2**31 - 1),
    "trainer.lr_warmup": (0, math.inf),
    "trainer.lr_final": (0, 1),
    "trainer.adam_eps": (0, 1),
    "trainer.sh_interval": (1, math.inf),
    "trainer.huber_delta": (1e-6, math.inf),
    "trainer.mouth_weight": (0, math.inf),
    "trainer.perceptual_weight": (0, math.inf),
    "trainer.dssim_weight": (0, math.inf),
    "trainer.perceptual_start": (0, 1),
    "trainer.lpips_every": (1, math.inf),
    "trainer.log_every": (1, math.inf),
    "trainer.preview_every": (1, math.inf),
    "trainer.checkpoint_every": (1, math.inf),
    "trainer.keep_checkpoints": (1, math.inf),
}
RANGES |= {f"trainer.learning_rates.{f.name}": (0.0, 10.0) for f in dataclasses.fields(LearningRates)}


def config_dir() -> Path:
    """The folder of YAML files: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "configs", package.parent / "configs"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise UserError(f"the configuration files are missing from the installation ({package / 'configs'})")


def load_config(overrides: Sequence[str] = ()) -> Config:
    """Compose configs/config.yaml with `key=value` or `group=option` overrides, later ones winning.

    Raises UserError for an unknown key or option, a wrong type or a value out of range.
    """
    return config_from_dict(OmegaConf.to_container(_composed(overrides), resolve=True))  # type: ignore[arg-type]


def chosen_options(overrides: Sequence[str] = ()) -> dict[str, str]:
    """The option of each group, such as {"model": "hypergaussians", "preset": "fast"}; raises as `load_config` does."""
    choices = _composed(overrides, hydra=True).hydra.runtime.choices
    return {group: option for group, option in choices.items() if group in _groups()}


def _composed(overrides: Sequence[str], hydra: bool = False) -> DictConfig:
    if long := next((override for override in overrides if len(override) > MAX_OVERRIDE), None):
        raise UserError(f"the override {long[:60]}... has {len(long)} characters; no value of a key needs that many")
    _check_overrides(overrides)
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            return compose("config", overrides=list(overrides), return_hydra_config=hydra)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(f"the configuration cannot be composed: {_cause(error)}") from None


def config_from_dict(values: dict[str, Any]) -> Config:
    """A checked Config from nested dictionaries, as a checkpoint or a composed YAML holds them."""
    try:
        merged = OmegaConf.merge(OmegaConf.structured(Config), values)
        config = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        key = str(error.full_key or error.key)
        raise UserError(f"the configuration value {key} is not valid: {_cause(error)}{_nearest_hint(key)}") from None
    assert isinstance(config, Config)
    config.data.background = tuple(config.data.background)  # type: ignore[assignment]
    _check_values(config)
    return config


def _check_values(config: Config) -> None:
    flat = flatten(config.to_dict())
    for key, choices in CHOICES.items():
        if flat[key] not in choices:
            raise UserError(f"{key}={flat[key]} is not one of {', '.join(choices)}")
    for key, (low, high) in RANGES.items():
        value = flat[key]
        if value is not None and not low <= value <= high:
            raise UserError(f"{key}={value} is out of range: it must lie between {low:g} and {high:g}")
    check_device(config.device)
    if any(not 0.0 <= c <= 1.0 for c in config.data.background):
        raise UserError(f"data.background={list(config.data.background)} must be three values from 0 to 1")


def check_device(name: str) -> None:
    if not DEVICE.fullmatch(name):
        raise UserError(f"device={name} is not one of auto, cpu, cuda, cuda:N (such as cuda:0)")


def _check_overrides(overrides: Sequence[str]) -> None:
    groups = _groups()
    keys = _known_keys()
    for override in overrides:
        key, separator, value = override.partition("=")
        if not separator or not key:
            raise UserError(f"'{override}' is not of the form key=value")
        if key in groups:
            if value not in groups[key]:
                raise UserError(f"{key}={value}: there is no such file; configs/{key}/ has {', '.join(groups[key])}")
        elif key not in keys:
            raise UserError(f"there is no configuration key '{key}'{_nearest_hint(key, list(groups))}")


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
    if key in known:
        return ""
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


def _cause(error: Exception) -> str:
    """The first line of the innermost message: Hydra wraps the cause in several others."""
    while error.__cause__ is not None and isinstance(error.__cause__, Exception):
        error = error.__cause__
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
