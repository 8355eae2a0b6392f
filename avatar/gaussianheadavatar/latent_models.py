"""Gaussian Head Avatar whose networks give latents: with HyperGaussians, and with N-dimensional Gaussians."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor, nn

from avatar.baselines.ndgs import NdGaussians, Slice
from avatar.config import ModelConfig
from avatar.data.frame import Frame
from avatar.gaussianheadavatar.hyper_sets import Attributes, HyperSets
from avatar.gaussianheadavatar.model import WITHOUT_EFFECT, GaussianHeadAvatar, channels_of
from avatar.gaussianheadavatar.networks import ATTRIBUTES, Blended, Outputs


class HyperGaussianHeadAvatar(GaussianHeadAvatar):
    """With HyperGaussians: the networks give five latents, which condition what the networks gave before."""

    without_effect = WITHOUT_EFFECT

    @staticmethod
    def make_hyper(config: ModelConfig, N: int) -> nn.Module:
        return HyperSets(N, channels_of(config), config.latent_dim)

    @staticmethod
    def outputs(config: ModelConfig) -> Outputs:
        n = config.latent_dim
        return Outputs(n, n, 3 * n)

    def attributes(self, blended: Blended) -> Attributes:
        assert isinstance(self.hyper, HyperSets)
        return self.hyper(*blended)

    def initialize_colours(self, colours: Float[Tensor, "N C"], frames: list[Frame]) -> None:
        assert isinstance(self.hyper, HyperSets)
        self.hyper.start_colour(colours)

    def deformed(
        self, values: Float[Tensor, "M n"], rows: Int[Tensor, " M"] | None = None
    ) -> tuple[Float[Tensor, "M 3"], None]:
        assert isinstance(self.hyper, HyperSets)
        return self.hyper.position(values, rows), None

    def motion_parameters(self) -> list[nn.Parameter]:
        assert isinstance(self.hyper, HyperSets)
        return list(self.hyper.position.parameters())


class NdgsHeadAvatar(GaussianHeadAvatar):
    """With N-dimensional Gaussians, which the latent moves and fades; colours and shapes are the networks' own."""

    without_effect = WITHOUT_EFFECT

    @staticmethod
    def make_hyper(config: ModelConfig, N: int) -> nn.Module:
        return NdGaussians(N, config.latent_dim)

    @staticmethod
    def outputs(config: ModelConfig) -> Outputs:
        return Outputs(config.latent_dim, channels_of(config), ATTRIBUTES)

    def attributes(self, blended: Blended) -> Attributes:
        shift, density = self.deformed(blended.deformation)
        return super().attributes(blended._replace(deformation=shift))._replace(density=density)

    def deformed(self, values: Float[Tensor, "M n"], rows: Int[Tensor, " M"] | None = None) -> Slice:
        assert isinstance(self.hyper, NdGaussians)
        return self.hyper(values, rows)

    def motion_parameters(self) -> list[nn.Parameter]:
        assert self.hyper is not None
        return list(self.hyper.parameters())
