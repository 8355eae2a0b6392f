"""The models by name: what `model=NAME` makes."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from avatar.baselines.covariance import CovarianceAvatar
from avatar.baselines.monogaussianavatar import MonoGaussianAvatar
from avatar.baselines.ndgs import NdgsAvatar
from avatar.baselines.splattingavatar import SplattingAvatar
from avatar.config import ModelConfig
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
}


def make_avatar(assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> Avatar:
    """A new avatar of the model that the configuration names."""
    return MODELS[config.name](assets, identity, config)
