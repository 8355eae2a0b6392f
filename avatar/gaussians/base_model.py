"""What every model is to the rest of the program: a frame's head parameters in, Gaussians out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from typing import Any, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.compute.device import on_gpu, to_device
from avatar.compute.memory import Need
from avatar.config import Initialization, ModelConfig, TrainerConfig
from avatar.data.frame import Frame
from avatar.gaussians.deformation import DeformationMLP
from avatar.gaussians.encoding import encoded_size
from avatar.gaussians.head_rotation import VALUES, head_rotation_input, learned_turning
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.splat import splat
from avatar.types import Camera, FeatureGaussians, Gaussians, HeadParams, Rendering

CONDITION_EXTRAS = 20  # jaw 6, eyes 12, eyelids 2, after the expression coefficients

Groups = dict[str, tuple[Sequence[Tensor], float]]  # parameters and their learning rate, by what they are


class Avatar(nn.Module):
    """One person's avatar.

    A model is a subclass. It makes its parameters in `make_parameters`, gives `forward`, `count_gaussians`,
    `initialize_from` and `parameter_groups`, and of the other methods those in which it differs.
    `avatar.runs.model_registry` lists the models by name; most are an `avatar.gaussians.uv_base_model.UVAvatar`.

    `mesh` is `head`, or goes on after its vertices and triangles. `to(device)` moves all that drawing needs. `head` and
    `mesh` stay on the CPU; cameras and head parameters may be on either side.
    """

    is_fused = False  # whether a GPU has kernels for all that follows the network, in place of torch's own operations
    is_replayable = True  # whether steps, and frames, do the same operations each time
    unknown_to_browsers: str | None = "this model"  # why it cannot be exported for browsers; None: it can
    has_colours = True  # whether each Gaussian has a colour; else `draw` makes colours of features
    without_effect: tuple[str, ...] = ("upsampling",)  # keys of `ModelConfig` that this model does not read
    trained_without: tuple[str, ...] = ()  # keys of `TrainerConfig` that change nothing in its training
    has_surface = False  # whether points can start on a surface that is fitted to training frames
    initial_frames = 16  # that `initialize_from` gets, evenly spread over the training frames
    turning: Tensor | None  # of `avatar.gaussians.head_rotation`; zeros until `learn_head_rotation`

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.head = self.mesh = HeadModel(assets, identity)
        self.make_parameters(config, assets.num_expressions, self.count_gaussians(config, assets))
        self.register_load_state_dict_post_hook(lambda avatar, _: avatar.after_load())

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.opacity_logits)

    @classmethod
    def count_gaussians(cls, config: ModelConfig, assets: HeadAssets) -> int:
        """How many Gaussians an avatar of this head has. Raises ValueError where there would be none."""
        raise NotImplementedError

    def forward(
        self,
        params: HeadParams,
        vertices: Float[Tensor, "V 3"] | None = None,
        rotation: Float[Tensor, "3 3"] | None = None,
    ) -> Gaussians | FeatureGaussians:
        """The Gaussians of one frame, world space.

        vertices  the head posed by `params` already, metres
        rotation  `head_rotation` of the camera that sees it; None: the head is turned as on average in training
        """
        raise NotImplementedError

    def make_parameters(self, config: ModelConfig, num_expressions: int, N: int) -> None:
        """Make every tensor of the state dict; from sizes alone, so that `shapes` needs no memory."""
        self.register_buffer("turning", None)
        self.log_scales = nn.Parameter(torch.zeros(N, 3))
        self.quats = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(N, 1))
        self.opacity_logits = nn.Parameter(torch.logit(torch.tensor(config.initial_opacity)).repeat(N))

    def initialize_from(self, frames: Iterable[Frame], start: Initialization) -> None:
        """Before training: set from training frames what `trainer.initialization` says."""
        raise NotImplementedError

    def make_network(self, config: ModelConfig, num_expressions: int, out_size: int) -> DeformationMLP:
        """A network that takes `condition`; for `make_parameters`."""
        condition_size = num_expressions + CONDITION_EXTRAS
        if config.head_rotation:
            self.turning, condition_size = torch.zeros(VALUES, 9), condition_size + VALUES
            self._turning_on_cpu = self.turning
        return DeformationMLP(encoded_size(), condition_size, out_size, config.mlp_width, config.mlp_layers)

    @classmethod
    def shapes(cls, config: ModelConfig, num_expressions: int, gaussians: int) -> dict[str, tuple[int, ...]]:
        """The shape of every tensor in the state dict, by name; nothing is allocated."""
        with torch.device("meta"):
            blank = cls.__new__(cls)
            nn.Module.__init__(blank)
            blank.make_parameters(config, num_expressions, gaussians)
            return {name: tuple(value.shape) for name, value in blank.state_dict().items()}

    @classmethod
    def most_places(cls, config: ModelConfig, gaussians: int) -> int:
        """At how many places the network is evaluated, at most."""
        return gaussians

    @classmethod
    def step_needs(cls, config: ModelConfig, gaussians: int, size: tuple[int, int]) -> list[Need]:
        """What a training step on frames of `size` (width, height) takes beside what those of all models take."""
        return []

    def parameter_groups(self, trainer: TrainerConfig) -> Groups:
        """Adam's groups of parameters with their learning rates."""
        raise NotImplementedError

    def zoom_limits(self, trainer: TrainerConfig) -> tuple[float, float] | None:
        """The least and largest factor that training pictures of several cameras are zoomed by; None: they are not."""
        return None

    def after_step(self, optimizer: torch.optim.Adam, steps: int, config: TrainerConfig) -> None:
        """Called after `steps` steps. A function of parameters, step and seed, so that a resumed run repeats them."""

    def after_load(self) -> None:
        """Called after parameters were loaded. Raises ValueError for those that cannot be."""
        if self.turning is not None and not self.turning.is_meta:
            self._turning_on_cpu = self.turning.cpu()

    def frozen(self) -> Self:
        """A copy for inference, the same to rounding: without gradients, and what never changes is computed once."""
        shared = {id(part): part for part in (self.head, self.mesh)}
        return deepcopy(self, shared | {id(part): other for part, other in self.folded().items()}).requires_grad_(False)

    def folded(self) -> dict[Any, Any]:
        """Parts, and what takes their place in a frozen copy."""
        return {}

    def draw(self, gaussians: Any, camera: Camera, background: Float[Tensor, " 3"], **options: Any) -> Rendering:
        """A picture of what `forward` gave; `options` as those of `splat`."""
        return splat(gaussians, camera, background, **{"blur": self.config.blur, **options})

    def training_images(
        self, gaussians: Any, camera: Camera, background: Float[Tensor, " 3"], sh_degree: int
    ) -> list[Float[Tensor, "_ _ 3"]]:
        """What a training step compares with the frame: the picture, then smaller ones where the model draws any."""
        return [self.draw(gaussians, camera, background, sh_degree=sh_degree).image]

    @property
    def device(self) -> torch.device:
        return self.quats.device

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)
        for part in vars(self).values():
            if hasattr(part, "move"):  # it is no module
                part.move(self.device)
        return self

    def vertices(self, params: HeadParams) -> Float[Tensor, "V 3"]:
        """The posed mesh where the avatar is, metres, the head model's vertices first; on a GPU without gradients."""
        return self.mesh.vertices_on_gpu(params, self.device) if on_gpu(self.quats) else self.mesh.vertices(params)

    def condition(self, params: HeadParams, rotation=None) -> Float[Tensor, " D"]:
        """A network's input for what `forward` takes; coefficients that the frame does not carry are zeros."""
        parts = [params.expression, params.jaw, params.eyes, params.eyelids]
        missing = self.head.assets.num_expressions - len(params.expression)
        if missing > 0:
            parts.insert(1, params.jaw.new_zeros(missing))
        if self.turning is not None:
            turned = params.jaw.new_zeros(VALUES) if rotation is None else self.head_rotation(rotation)
            parts.append(to_device(turned, params.jaw.device))
        return to_device(torch.cat(parts), self.device)

    def head_rotation(self, rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 3"]:
        """The network's input for this rotation of the head before the reference camera (`model.head_rotation`).

        Where `rotation` is, so that a camera on the CPU costs a GPU one copy.
        """
        assert self.turning is not None
        beside = self.turning if self.turning.device == rotation.device else self._turning_on_cpu
        return head_rotation_input(beside, rotation)

    def learn_head_rotation(self, rotations: Float[Tensor, "T 3 3"]) -> None:
        """Before training: how heads are turned before the reference camera at its times."""
        if self.turning is not None:
            self.turning.copy_(learned_turning(rotations))
            self._turning_on_cpu = self.turning.cpu()
