"""The configuration. Every key is declared here once: its type, default, range and meaning.

The defaults are the default recipe. The YAML files of configs/model/ and configs/experiment/ hold what differs from it;
Hydra composes them. An unknown key, a wrong type or a value out of range is refused with a sentence that names the key
and the nearest one.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Annotated, Any, Literal, get_type_hints

from avatar.config_values import Range, cause, check_device, checked_value, config_dir, meaning_of, shown, typed_value
from avatar.data.colours import Colour
from avatar.errors import UserError

MAX_OVERRIDE = 1000  # characters; a message quotes the override
MOST_STEPS = 99_999_999  # checkpoints are named with eight digits
PROTOCOLS = "protocol"  # the folder of configs/ that holds evaluation protocols; no part of a configuration
STEPS, WEIGHT, SHARE, RATE = Range(1, MOST_STEPS), Range(0, 10**6), Range(0, 1), Range(0, 10)

Initialization = Literal["grey", "frames", "surface"]


@dataclass
class DataConfig:
    """How the prepared subject is read."""

    size: Annotated[int | None, Range(16, 8192), "width of the training images in pixels; null: the video's"] = None
    background: Annotated[Colour, "colour behind the head: a name, #RRGGBB or [r,g,b]"] = (1.0, 1.0, 1.0)
    test_frames: Annotated[
        int | None,
        STEPS,
        "frames (of several cameras: times) held out at the end; null: 500, or 20% of a clip under 2,500",
    ] = None
    test_cameras: Annotated[
        str | None, "cameras held out, names between commas, or none; null: as the folder says, else none"
    ] = None


@dataclass
class ModelConfig:
    """The avatar's architecture; the checkpoint holds it, and it cannot change afterwards."""

    name: Annotated[
        Literal[
            "hypergaussians",
            "flashavatar",
            "covariance",
            "ndgs",
            "splattingavatar",
            "monogaussianavatar",
            "gaussianheadavatar",
            "gaussianheadavatar_hyper",
            "gaussianheadavatar_ndgs",
        ],
        "the method; model=NAME sets it",
    ] = "hypergaussians"
    uv_size: Annotated[int, Range(2, 2048), "texels a side of the UV raster; one Gaussian per covered texel"] = 128
    uv_detail: Annotated[int, Range(1, 8), "how many times finer the raster is around mouth and eyes"] = 2
    latent_dim: Annotated[int, Range(1, 4096), "n, dimensions of the latent"] = 8
    latent_grid: Annotated[
        int | None, Range(1, 2048), "cells a side of the UV grid that latents are interpolated from; null: no grid"
    ] = 8
    mlp_width: Annotated[int, Range(1, 65536), "neurons per hidden layer of the deformation network"] = 128
    mlp_layers: Annotated[int, Range(1, 1000), "hidden layers of the deformation network"] = 6
    initial_opacity: Annotated[float, Range(1e-6, 1 - 1e-6), "opacity of every Gaussian before training"] = 0.3
    blur: Annotated[float, Range(0, 100), "pixels^2 added to both variances of a projected Gaussian"] = 0.05
    skull_binding: Annotated[bool, "learn how far each Gaussian moves with the skull instead of the skin"] = True
    head_rotation: Annotated[bool, "give the network the head's rotation relative to the camera"] = True
    upsampling: Annotated[
        Literal[1, 2, 4], "of gaussianheadavatar: how many times larger the picture is than the splatted image"
    ] = 2
    teeth: Annotated[bool, "add two rows of Gaussians behind the lips that move with skull and jaw"] = True


# Adam's learning rates that do not vary; `LearningRates` has the others.
OPACITY_RATE = 0.05  # of logits: of opacities and of skull shares
NETWORK_RATE = 1e-4  # of the deformation network
HYPER_RATE = 1e-4  # of the HyperGaussian heads, and of learned places on the mesh (metres)


@dataclass
class LearningRates:
    """Adam's learning rates of the Gaussians."""

    sh_dc: Annotated[float, RATE, "base colour"] = 1.0e-2
    sh_rest: Annotated[float, RATE, "view-dependent colour"] = 2.5e-3
    scale: Annotated[float, RATE, "logarithm of the scale"] = 2.0e-2
    rotation: Annotated[float, RATE, "base quaternion"] = 4.0e-3


@dataclass
class TrainerConfig:
    """The optimisation."""

    iterations: Annotated[int, STEPS, "optimizer steps, one random training frame each"] = 4000
    max_epochs: Annotated[int | None, STEPS, "most passes over the training frames; null: no limit"] = 10
    seed: Annotated[int, Range(0, 2**31 - 1), "seed of the initial weights and of the order of frames"] = 0
    learning_rates: LearningRates = field(default_factory=LearningRates)
    lr_decay: Annotated[bool, "warm up, then decay all learning rates along half a cosine; false: constant"] = True
    initialization: Annotated[
        Initialization,
        "grey; frames: the mean colour that training frames show at each Gaussian; surface: of gaussianheadavatar, also "
        "points of a surface that is fitted to them",
    ] = "frames"
    perceptual: Annotated[
        Literal["auto", "lpips-squeeze", "lpips-vgg", "lpips-alex", "dssim", "none"],
        "perceptual loss; auto: LPIPS of SqueezeNet if its weights are there, else D-SSIM",
    ] = "auto"
    sparse_lpips: Annotated[bool, "LPIPS of the head's box in every tenth step; false: of the frame in every step"] = (
        True
    )
    dssim_weight: Annotated[float, WEIGHT, "weight of D-SSIM in steps where it replaces LPIPS"] = 0.2
    dssim_early: Annotated[float, WEIGHT, "weight of D-SSIM before the perceptual loss begins"] = 0.1
    # Of no factor in common with SPARSE_EVERY, so that a sparse LPIPS sees both backgrounds.
    opposite_background_every: Annotated[
        int | None, STEPS, "every so many-th step is over the background's opposite, 0 or 1 in each channel; null: none"
    ] = 3
    pose_rate: Annotated[
        float, SHARE, "learning rate of the training frames' pose corrections, in half degrees and millimetres; 0: none"
    ] = 0.01
    condition_noise: Annotated[
        float, SHARE, "noise on the network's input, as a share of each coefficient's standard deviation"
    ] = 0.2
    checkpoint_every: Annotated[int, STEPS, "steps between checkpoints, each with a preview image"] = 500


@dataclass
class Config:
    """Everything that decides the result of a training run, apart from its input."""

    data: DataConfig = field(default_factory=DataConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    device: Annotated[str, "cpu, cuda, cuda:N; auto: a GPU that passes its test, else the CPU"] = "auto"

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def load_config(overrides: Sequence[str] = ()) -> Config:
    """The default recipe with `group=option` and `key=value` overrides, keys after groups, later ones winning.

    `trainer.iterations` without `trainer.max_epochs` lifts the limit of passes over the frames.
    Raises UserError for an unknown key or option, a wrong type or a value out of range.
    """
    files, _ = _composed(overrides)
    values = _merged(Config().to_dict(), files)
    given = dict(override.split("=", 1) for override in overrides if override.partition("=")[0] not in _groups())
    for key, text in given.items():
        *sections, name = key.split(".")
        reduce(dict.__getitem__, sections, values)[name] = typed_value(text, _declaration(key))
    if "trainer.iterations" in given and "trainer.max_epochs" not in given:
        values["trainer"]["max_epochs"] = None
    return config_from_dict(values)


def chosen_options(overrides: Sequence[str] = ()) -> dict[str, str]:
    """The option of each group, such as {"model": "hypergaussians", "experiment": "none"}; raises as `load_config` does."""
    _, choices = _composed(overrides)
    return {group: choices[group] or "none" for group in sorted(_groups(), reverse=True)}


def _composed(overrides: Sequence[str]) -> tuple[dict[str, Any], dict[str, str | None]]:
    """What the files of the chosen options say, and these options; other overrides have only been checked for their key."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if long := next((override for override in overrides if len(override) > MAX_OVERRIDE), None):
        raise UserError(f"the override {long[:60]}... has {len(long)} characters; no value of a key needs that many")
    _check_overrides(overrides)
    chosen = [override for override in overrides if override.partition("=")[0] in _groups()]
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            composed = compose("config", overrides=chosen, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(f"the configuration cannot be composed: {cause(error)}") from None
    choices = dict(composed.hydra.runtime.choices)
    values = OmegaConf.to_container(composed)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items() if key != "hydra"}, choices


def _merged(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Nested dictionaries with some values changed."""
    merged = dict(values)
    for key, change in changes.items():
        known = values.get(key)
        merged[key] = _merged(known, change) if isinstance(known, dict) and isinstance(change, dict) else change
    return merged


def config_from_dict(values: dict[str, Any]) -> Config:
    """A checked Config from nested dictionaries, as a checkpoint holds them.

    Raises UserError for keys that are missing or unknown, wrong types and values out of range.
    """
    config = _section(values, Config, "")
    assert isinstance(config, Config)
    check_device(config.device)
    return config


def _section(values: Any, schema: type, prefix: str) -> Any:
    """The dataclass `schema` of a dictionary; `prefix` is what its keys are called by."""
    if not isinstance(values, dict):
        raise UserError(f"the configuration has {shown(values)} where the keys {prefix}* should be")
    kinds = get_type_hints(schema, include_extras=True)
    if unknown := [key for key in values if key not in kinds]:
        raise _no_such_key(f"{prefix}{unknown[0]}")
    if missing := [key for key in kinds if key not in values]:
        raise UserError(f"the configuration lacks {prefix}{missing[0]}")
    return schema(
        **{
            name: _section(values[name], kind, f"{prefix}{name}.")
            if dataclasses.is_dataclass(kind) and isinstance(kind, type)
            else checked_value(f"{prefix}{name}", values[name], kind)
            for name, kind in kinds.items()
        }
    )


def _check_overrides(overrides: Sequence[str]) -> None:
    groups, keys = _groups(), declared_keys()
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


def declared_keys(schema: type = Config, prefix: str = "") -> dict[str, str]:
    """Every key, as it is written in overrides, and what it means."""
    keys: dict[str, str] = {}
    for name, kind in get_type_hints(schema, include_extras=True).items():
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            keys |= declared_keys(kind, f"{prefix}{name}.")
        else:
            keys[f"{prefix}{name}"] = meaning_of(kind)
    return keys


def check_value(key: str, value: Any, name: str) -> None:
    """Raises UserError, in which the key is called `name`, for a value that it cannot have."""
    checked_value(name, value, _declaration(key))


def _declaration(key: str) -> Any:
    """The annotation of a key's field."""
    return reduce(lambda schema, part: get_type_hints(schema, include_extras=True)[part], key.split("."), Config)


def _nearest_hint(key: str, groups: Sequence[str] = ()) -> str:
    known = [*declared_keys(), *groups]
    by_last = {name.rsplit(".", 1)[-1]: name for name in known}
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    near = near or [by_last[m] for m in difflib.get_close_matches(key.rsplit(".", 1)[-1], list(by_last), n=1)]
    return f"; the nearest is '{near[0]}'" if near else ""


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dictionaries as one, with keys as they are written in overrides: `trainer.learning_rates.scale`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
