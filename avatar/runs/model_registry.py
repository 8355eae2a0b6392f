"""The models by name: what `model=NAME` makes."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from avatar.baselines.covariance import CovarianceAvatar
from avatar.baselines.monogaussianavatar import MonoGaussianAvatar
from avatar.baselines.ndgs import NdgsAvatar
from avatar.baselines.splattingavatar import SplattingAvatar
from avatar.config import ModelConfig
from avatar.errors import UserError
from avatar.gaussianheadavatar.latent_models import HyperGaussianHeadAvatar, NdgsHeadAvatar
from avatar.gaussianheadavatar.model import GaussianHeadAvatar
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets
from avatar.model import FlashAvatar, HyperGaussianAvatar

MODELS: dict[str, type[Avatar]] = {
    "hypergaussians": HyperGaussianAvatar,
    "flashavatar": FlashAvatar,
    "covariance": CovarianceAvatar,
    "ndgs": NdgsAvatar,
    "splattingavatar": SplattingAvatar,
    "monogaussianavatar": MonoGaussianAvatar,
    "gaussianheadavatar": GaussianHeadAvatar,
    "gaussianheadavatar_hyper": HyperGaussianHeadAvatar,
    "gaussianheadavatar_ndgs": NdgsHeadAvatar,
}


def refuse_features(config: ModelConfig, what: str) -> None:
    """Raise UserError for a model whose Gaussians have features in place of colours, which `what` cannot use."""
    if not MODELS[config.name].has_colours:
        raise UserError(
            f"{what} needs Gaussians that have colours, those of model={config.name} have features for a network; train "
            "with model=hypergaussians"
        )


def keys_without_effect(overrides: Sequence[str], name: str) -> list[str]:
    """Those keys among the overrides that the model `name` does not read."""
    unread = {f"model.{key}" for key in MODELS[name].without_effect}
    unread |= {f"trainer.{key}" for key in MODELS[name].trained_without}
    return [key for override in overrides if (key := override.partition("=")[0]) in unread]


def make_avatar(assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> Avatar:
    """A new avatar of the model that the configuration names."""
    return MODELS[config.name](assets, identity, config)
