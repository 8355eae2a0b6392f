"""Gaussian Head Avatar: free Gaussians with features, moved and coloured by networks, drawn small and enlarged.

    head parameters -> networks, blended by the distance to the face -> [HyperGaussians] -> Gaussians at rest
                    -> splatted features -> upsampler -> picture

Lengths of the networks' side are in half head lengths, as in the paper, whose heads are 2 long.

Source: Xu et al., Gaussian Head Avatar (CVPR 2024); HyperGaussians (CVPR 2026), supplement. docs/bench/cameras.md lists
what differs from them: `initialize_from` stands for the first stage. It takes motion from the mesh, and geometry and first
colours from frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d, normalize

from avatar.compute.device import to_device
from avatar.compute.memory import Need
from avatar.config import Initialization, LearningRates, ModelConfig, TrainerConfig
from avatar.data.frame import Frame
from avatar.gaussianheadavatar.hyper_sets import Attributes
from avatar.gaussianheadavatar.initial_gaussians import initial_gaussians
from avatar.gaussianheadavatar.initial_motion import MeshMotion, fit_motion, random_heads
from avatar.gaussianheadavatar.networks import ATTRIBUTES, Blended, Networks, Outputs, encode, nearness
from avatar.gaussianheadavatar.start_points import landmarks
from avatar.gaussianheadavatar.upsampler import Upsampler
from avatar.gaussians.base_model import CONDITION_EXTRAS, Avatar, Groups
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.uv import bound_texels
from avatar.head.assets import HeadAssets
from avatar.head.features import region_or_all
from avatar.head.model import matrix_from_6d, nearest_rotation
from avatar.splat import splat_features
from avatar.tensors import take_rows
from avatar.types import Camera, FeatureGaussians, HeadParams, Rendering

FEATURES = 128  # of a point, which networks for colour and shape take
NEAR, FAR = math.sqrt(0.1), math.sqrt(0.25)  # to the nearest landmark, half head lengths: what follows the expression
SHIFT, CHANGE = 0.3, 0.2  # factors of the deformation, and of the changes of scale, rotation and opacity
BEYOND = 2  # one Gaussian beyond the mesh for so many on it
STEPS = 600_000  # published; with fewer steps all rates are higher, by the root of the ratio
MOST_BOOST = 10.0
ZOOM = 0.8, 1.25
COVERED = 0.3  # alpha from which on a pixel is the upsampler's alone
POINT_RATE, ROTATION_RATE, SCALE_RATE, OPACITY_RATE, NETWORK_RATE = 1e-5, 1e-5, 3e-5, 1e-4, 1e-4
LAYERS = 46  # widths of floats that a Gaussian's networks keep in a step, measured
FIT_STEPS, FIT_POINTS, FIT_RATE = 300, 4096, 1e-3  # of the colour networks to the first colours
WITHOUT_EFFECT = "latent_grid", "mlp_layers", "skull_binding", "head_rotation", "teeth"


class GaussianHeadAvatar(Avatar):
    """`model.mlp_width` is the networks' width, as published 256; a Gaussian has an eighth of it as feature channels.
    The splatted image is `model.upsampling` times smaller than the picture."""

    is_replayable = False  # each path of the networks runs on the points that it counts for
    has_colours = False
    unknown_to_browsers = "its upsampling network"
    without_effect = *WITHOUT_EFFECT, "latent_dim"
    trained_without = "opposite_background_every", *(f"learning_rates.{rate.name}" for rate in fields(LearningRates))
    has_surface = True
    initial_frames = 48
    centre: Tensor  # of the head at rest, metres
    places: Tensor  # landmarks, half head lengths from the centre
    mean_rotation: Tensor  # of the head before the reference camera in training

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> None:
        super().__init__(assets, identity, config)
        vertices = self.head.neutral_vertices()
        skull = vertices[self.head.neck()[1] > 0.5]
        skull = skull if len(skull) else vertices  # a head model whose neck does not bend
        low, high = skull.amin(dim=0), skull.amax(dim=0)
        self.unit = 0.5 * float((high - low)[1])
        face = region_or_all(assets, "face")
        self.register_buffer("centre", 0.5 * (low + high), persistent=False)
        self.register_buffer("places", (landmarks(vertices, face) - self.centre) / self.unit, persistent=False)

    @classmethod
    def count_gaussians(cls, config: ModelConfig, assets: HeadAssets) -> int:
        on_mesh = len(bound_texels(assets, assets, config.uv_size, config.uv_detail).face)
        return on_mesh + on_mesh // BEYOND

    def make_parameters(self, config: ModelConfig, num_expressions: int, N: int) -> None:
        super().make_parameters(config, num_expressions, N)
        channels, outputs = channels_of(config), self.outputs(config)
        self.positions = nn.Parameter(torch.zeros(N, 3))  # metres, head at rest
        self.features = nn.Parameter(torch.zeros(N, FEATURES))
        theta = num_expressions + CONDITION_EXTRAS
        self.hyper = self.make_hyper(config, N)
        self.networks = Networks(theta, config.mlp_width, FEATURES, outputs, bounded=self.hyper is None)
        self.upsampler = Upsampler(channels, config.upsampling)
        self.register_buffer("mean_rotation", torch.eye(3))

    @staticmethod
    def make_hyper(config: ModelConfig, N: int) -> nn.Module | None:
        """The distributions that the networks' latents condition; None: there are no latents."""
        return None

    @staticmethod
    def outputs(config: ModelConfig) -> Outputs:
        """How many values the networks give."""
        return Outputs(3, channels_of(config), ATTRIBUTES)

    @torch.no_grad()
    def initialize_from(self, frames: Iterable[Frame], start: Initialization) -> None:
        """Put the Gaussians on the mesh, on the masks' hull or a fitted surface, and into the mouth. Raises UserError for
        masks that have nothing in common."""
        config, shown = self.config, list(frames)
        texels = bound_texels(self.head.assets, self.head.assets, config.uv_size, config.uv_detail)
        fitted = start == "surface"
        initial = initial_gaussians(self.head, texels, shown, len(self), self.centre, self.unit, fitted)
        self.positions.copy_(initial.positions)
        self.log_scales.copy_(initial.log_scales)
        self.features.copy_(first_features(self.normalized(initial.positions)))
        first = self.features.new_zeros(len(self), channels_of(config))
        first[:, :3] = 0.5 if start == "grey" else initial.colours
        self.initialize_colours(first, shown)
        self.initialize_motion(Embedding(self.head.assets, texels), [frame.params for frame in shown])

    def initialize_motion(self, mesh: Embedding, params: list[HeadParams]) -> None:
        """Fit the deformation near the face to the mesh's, with the head turned as on average."""
        expression, pose = self.networks.expression.deformation, self.networks.pose.deformation
        if self.hyper is None:  # else the pose's latents move nothing yet
            for parameter in pose.layers[-1].parameters():
                parameter.zero_()
        near = self.nearness()
        rows = near.nonzero()[:, 0]
        near, codes = near[rows, None], encode(self.normalized(self.positions[rows]))
        still = (1.0 - near) * pose(torch.cat((codes, encode(codes.new_zeros(6)).expand(len(codes), -1)), dim=-1))

        def moved(theta: Float[Tensor, "M C"], chosen: Int[Tensor, " M"]) -> tuple[Tensor, Tensor | None]:
            values = near[chosen] * expression(torch.cat((codes[chosen], theta), dim=-1)) + still[chosen]
            shift, density = self.deformed(values, rows[chosen])
            return SHIFT * self.unit * shift, density

        heads = random_heads(params)
        target = MeshMotion(self.head, mesh, self.positions[rows], heads)
        conditions = torch.stack([self.condition(head) for head in heads])
        fit_motion(moved, target, conditions, list(expression.parameters()), self.motion_parameters())
        self.zero_grad()

    def deformed(
        self, values: Float[Tensor, "M D"], rows: Int[Tensor, " M"] | None = None
    ) -> tuple[Float[Tensor, "M 3"], Float[Tensor, " M"] | None]:
        """What the deformation networks' outputs are for Gaussians `rows`: shifts, and factors of the opacity."""
        return values, None

    def motion_parameters(self) -> list[nn.Parameter]:
        """Of the Gaussians: what moves them beside the deformation networks."""
        return []

    def initialize_colours(self, colours: Float[Tensor, "N C"], frames: list[Frame]) -> None:
        """Fit the colour networks to these, whatever the frame's parameters."""
        branches = self.networks.expression, self.networks.pose
        optimizer = torch.optim.Adam([p for b in branches for p in b.colour.parameters()], FIT_RATE)
        near = self.nearness()
        for step in range(FIT_STEPS):
            rows = torch.randint(len(self), (min(FIT_POINTS, len(self)),))
            params = frames[step % len(frames)].params
            given = self.condition(params), self.pose(params, None)
            with torch.enable_grad():
                places = self.normalized(self.positions[rows])
                blended = self.networks(places, take_rows(self.features, rows), *given, near[rows])
                loss = (blended.colour - colours[rows]).square().mean()
                optimizer.zero_grad()
                loss.backward()
            optimizer.step()
        self.zero_grad()

    def forward(self, params: HeadParams, vertices=None, rotation=None) -> FeatureGaussians:
        given = self.condition(params), self.pose(params, rotation)
        changes = self.attributes(
            self.networks(self.normalized(self.positions), self.features, *given, self.nearness())
        )
        means = self.positions + SHIFT * self.unit * changes.position
        quats = normalize(self.quats + CHANGE * changes.rotation, dim=-1)
        scales = torch.exp(self.log_scales + CHANGE * changes.scale)
        opacities = torch.sigmoid(self.opacity_logits + CHANGE * changes.opacity[:, 0])
        opacities = opacities if changes.density is None else opacities * changes.density
        return FeatureGaussians(means, quats, scales, opacities, changes.colour)

    def attributes(self, blended: Blended) -> Attributes:
        """What the networks change."""
        scale, rotation, opacity = blended.attributes.split((3, 4, 1), dim=1)
        return Attributes(blended.deformation, blended.colour, rotation, scale, opacity)

    def nearness(self) -> Float[Tensor, " N"]:
        """How far each Gaussian follows the expression; the others follow the pose."""
        return nearness(self.normalized(self.positions.detach()), self.places, NEAR, FAR)

    def normalized(self, points: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """Half head lengths from the head's centre, of metres at rest."""
        return (points - self.centre) / self.unit

    def pose(self, params: HeadParams, rotation: Float[Tensor, "3 3"] | None) -> Float[Tensor, " 6"]:
        """The pose's input: how the head is turned, against its mean, and the neck, both as axis times angle."""
        neck = to_device(matrix_from_6d(params.neck), self.device)
        mean = self.mean_rotation
        turn = (
            torch.eye(3, device=self.device) if rotation is None else mean.T @ to_device(rotation.float(), self.device)
        )
        return rotation_matrix_to_axis_angle(torch.stack((turn, neck))).flatten()

    def draw(self, gaussians: Any, camera: Camera, background: Float[Tensor, " 3"], **options: Any) -> Rendering:
        return self.enlarged(self.splatted(gaussians, camera, **options), camera, background)

    def training_images(
        self, gaussians: Any, camera: Camera, background: Float[Tensor, " 3"], sh_degree: int
    ) -> list[Float[Tensor, "_ _ 3"]]:
        """The picture, and the first three channels of the splatted features, which are a small picture."""
        small = self.splatted(gaussians, camera)
        rgb = Rendering(small.image[..., :3], small.alpha)
        return [self.enlarged(small, camera, background).image, over_background(rgb, background).image]

    def splatted(self, gaussians: FeatureGaussians, camera: Camera, **options: Any) -> Rendering:
        """The features over white, at the small size."""
        options.pop("sh_degree", None)  # there is no view-dependent colour
        white = gaussians.features.new_ones(gaussians.features.shape[1])
        return splat_features(
            *gaussians, small_camera(camera, self.config.upsampling), white, blur=self.config.blur, **options
        )

    def enlarged(self, small: Rendering, camera: Camera, background: Float[Tensor, " 3"]) -> Rendering:
        height, width, factor = camera.height, camera.width, self.config.upsampling
        alphas = small.alpha[None, None]
        alpha = interpolate(alphas, scale_factor=factor, mode="bilinear")[0, 0, :height, :width]
        # A sigmoid is never 1: the upsampler's picture fades into the background where splats hardly cover it.
        covered = max_pool2d(alphas, 3, stride=1, padding=1)
        covered = interpolate(covered, scale_factor=factor, mode="bilinear")[0, 0, :height, :width, None]
        share = (covered / COVERED).clamp(max=1.0)
        image = 1.0 + share * (self.upsampler(small.image)[:height, :width] - 1.0)
        return over_background(Rendering(image, alpha), background)

    def learn_head_rotation(self, rotations: Float[Tensor, "T 3 3"]) -> None:
        self.mean_rotation.copy_(nearest_rotation(rotations.mean(dim=0)))

    def parameter_groups(self, trainer: TrainerConfig) -> Groups:
        """The published rates; a training of fewer steps has higher ones."""
        boost = min(math.sqrt(STEPS / trainer.iterations), MOST_BOOST)
        branches = self.networks.expression, self.networks.pose
        networks = [p for branch in branches for p in branch.deformation.parameters()]
        motion = [*networks, *self.motion_parameters()]
        own = [] if self.hyper is None else list(self.hyper.parameters())
        learned = [*self.networks.parameters(), *self.upsampler.parameters(), *own]
        moving = {id(parameter) for parameter in motion}
        return {
            "positions": ([self.positions], boost * POINT_RATE * self.unit),
            "features": ([self.features], boost * POINT_RATE),
            "logits": ([self.opacity_logits], boost * OPACITY_RATE),
            "scale": ([self.log_scales], boost * SCALE_RATE),
            "rotation": ([self.quats], boost * ROTATION_RATE),
            "motion": (motion, math.sqrt(boost) * NETWORK_RATE),  # which starts as the mesh's
            "network": ([parameter for parameter in learned if id(parameter) not in moving], boost * NETWORK_RATE),
        }

    def zoom_limits(self, trainer: TrainerConfig) -> tuple[float, float] | None:
        """In as many steps as published; 600 steps end worse with it."""
        return ZOOM if trainer.iterations >= STEPS else None

    @classmethod
    def step_needs(cls, config: ModelConfig, gaussians: int, size: tuple[int, int]) -> list[Need]:
        """The upsampler's images: at each size four of the width there, with gradients, and what autograd keeps."""
        pixels, channels = size[0] * size[1] / config.upsampling**2, channels_of(config)
        stages = range(config.upsampling.bit_length())
        values = sum(pixels * 4**i * 6 * (4 * channels >> i) for i in stages)
        return [
            Need("the upsampler's images", round(4 * values), "--size or model.mlp_width"),
            Need("the networks' layers", 4 * LAYERS * config.mlp_width * gaussians, "model.uv_size or model.mlp_width"),
        ]


def channels_of(config: ModelConfig) -> int:
    return max(config.mlp_width // 8, 4)


def first_features(places: Float[Tensor, "N 3"]) -> Float[Tensor, "N F"]:
    """Random functions of the place: points beside each other have alike features."""
    codes = encode(places)
    weights = torch.randn(codes.shape[1], FEATURES, generator=torch.Generator().manual_seed(0)).to(codes)
    return codes @ weights * codes.shape[1] ** -0.5


def small_camera(camera: Camera, factor: int) -> Camera:
    """The camera of an image `factor` times smaller, with a row and column more where sides are no multiples."""
    lens = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, **lens, width=-(-camera.width // factor), height=-(-camera.height // factor))


def over_background(white: Rendering, background: Float[Tensor, " 3"]) -> Rendering:
    """What was drawn over white, over another background."""
    return Rendering(white.image + (1.0 - white.alpha)[..., None] * (background - 1.0), white.alpha)
