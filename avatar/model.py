"""The avatar: one frame's head parameters in, Gaussians out. The whole method on one page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.compute.device import on_gpu, to_device
from avatar.config import ModelConfig
from avatar.gaussians.compose import compose_carried, compose_raw, compose_slice
from avatar.gaussians.covariance import CovarianceHeads
from avatar.gaussians.deformation import DeformationMLP
from avatar.gaussians.embedding import Embedding, knn_scales
from avatar.gaussians.encoding import encoded_size, positional_encoding
from avatar.gaussians.growth import alive_after, evenly_ordered
from avatar.gaussians.head_rotation import VALUES, head_rotation_input, learned_turning
from avatar.gaussians.hyper import HyperHeads
from avatar.gaussians.latent_grid import LatentGrid, latent_grid
from avatar.gaussians.mesh_points import MeshPoints
from avatar.gaussians.ndgs import NdGaussians
from avatar.gaussians.skull_binding import INITIAL_LOGIT, Skull, SkullBinding, bind_to_skull
from avatar.gaussians.uv import bound_texels
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel, PoseTensors
from avatar.head.teeth import with_teeth
from avatar.splat import splat
from avatar.types import Camera, Gaussians, HeadParams, Rendering

CONDITION_EXTRAS = 20  # jaw 6, eyes 12, eyelids 2, after the expression coefficients
SH_DEGREE = 3  # of the view-dependent colour
WITH_LATENTS = ("hypergaussians", "covariance", "ndgs")


class Avatar(nn.Module):
    """One person's avatar, bound to the UV map of a head model.

    `name = "hypergaussians"`: the network gives each Gaussian a latent, its HyperGaussians turn that into offsets. With
    `latent_grid` the network is evaluated on that grid over the UV map and its latents are interpolated to the Gaussians.
    `name = "covariance"`: the same through the covariance; `name = "ndgs"`: the latent slices N-dimensional Gaussians.
    `name = "flashavatar"`: the network gives the offsets itself; they are not smooth over the map, so no grid is used.
    `name = "monogaussianavatar"`: the same for the first `count` points of a set that grows in training.
    `name = "splattingavatar"`: no network; learned places on the mesh, which alone moves the Gaussians.
    With `rigidity`, Gaussians that are bound to a texel learn how far they keep with the skull in place of the skin.
    With `head_rotation_input`, the network is told how the head is turned before the camera.
    With `teeth`, `mesh`, which Gaussians are bound to, goes on after the vertices and triangles of `head`; else it is
    `head`.

    `to(device)` moves all that drawing needs. `head` and `mesh` stay on the CPU, for those who look at them; cameras and
    head parameters may be on either side.
    """

    code: Tensor
    count: Tensor | None  # of the points that are alive; None: all are
    turning: Tensor | None  # of `avatar.gaussians.head_rotation`; zeros until `learn_head_rotation`

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        mesh = with_teeth(assets) if config.teeth else assets
        self.head = HeadModel(assets, identity)
        self.mesh = self.head if mesh is assets else HeadModel(mesh, identity)
        grows = config.name == "monogaussianavatar"
        texels = bound_texels(assets, mesh, config.uv_size, config.uv_detail)
        self.embedding = Embedding(mesh, evenly_ordered(texels) if grows else texels)
        N = len(self.embedding)
        alive = alive_after(0, 1, N) if grows else N
        neutral = self.embedding.points(self.mesh.neutral_vertices())
        has_latents = config.name in WITH_LATENTS
        self.grid: LatentGrid | None = None
        if has_latents and config.latent_grid is not None:
            self.grid = latent_grid(mesh, self.embedding.texels, neutral, config.latent_grid)
        places = neutral if self.grid is None else self.grid.places
        self.register_buffer("code", positional_encoding(places), persistent=False)

        self.deformation: DeformationMLP | None = None
        if config.name != "splattingavatar":
            self.deformation = DeformationMLP(
                code_size=encoded_size(),
                condition_size=assets.num_expressions + CONDITION_EXTRAS + (VALUES if config.head_rotation else 0),
                out_size=config.latent_dim if has_latents else 10,
                width=config.mlp_width,
                layers=config.mlp_layers,
            )
        tells = config.head_rotation and self.deformation is not None
        self.register_buffer("turning", torch.zeros(3, 9) if tells else None)
        self._turning_at_hand: Tensor | None = None  # on the CPU, where `turning` is not
        self.mesh_points: MeshPoints | None = None
        if config.name in ("splattingavatar", "monogaussianavatar"):
            place = self.embedding.texels.face, self.embedding.barycentric
            self.mesh_points = MeshPoints(mesh.faces, self.mesh.neutral_vertices(), *place, learned=not grows)
        self.register_buffer("count", torch.tensor(alive) if grows else None)
        self.hyper: HyperHeads | CovarianceHeads | None = None
        if config.name in ("hypergaussians", "covariance"):
            self.hyper = (HyperHeads if config.name == "hypergaussians" else CovarianceHeads)(N, config.latent_dim)
        self.ndgs = NdGaussians(N, config.latent_dim) if config.name == "ndgs" else None
        self.skull: Skull | None = None
        self.skull_logits: nn.Parameter | None = None
        if config.skull_binding and self.mesh_points is None:
            self.skull = Skull.of(self.mesh, self.embedding)
            self.skull_logits = nn.Parameter(torch.full((N,), INITIAL_LOGIT))

        initial_scale = torch.log(torch.cat((knn_scales(neutral[:alive]), knn_scales(neutral)[alive:])))
        self.log_scales = nn.Parameter(initial_scale[:, None].repeat(1, 3))
        self.quats = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(N, 1))
        initial_opacity = torch.logit(torch.tensor(config.initial_opacity))
        self.opacity_logits = nn.Parameter(initial_opacity.repeat(N))
        self.sh_dc = nn.Parameter(torch.zeros(N, 1, 3))
        self.sh_rest = nn.Parameter(torch.zeros(N, (SH_DEGREE + 1) ** 2 - 1, 3))
        self._pose: PoseTensors | None = None  # for posing on a GPU
        self.register_load_state_dict_post_hook(_check_loaded)

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.embedding)

    def forward(
        self,
        params: HeadParams,
        vertices: Float[Tensor, "V 3"] | None = None,
        rotation: Float[Tensor, "3 3"] | None = None,
        *,
        head_rotation: Float[Tensor, " 3"] | None = None,
    ) -> Gaussians:
        """The Gaussians of one frame, world space.

        vertices  the head posed by `params` already, metres
        rotation  R_cam_world of the camera that sees it; None: the head is turned as on average in training
        told      what `head_rotation` gave for that rotation, if it is there already
        """
        vertices = self.vertices(params) if vertices is None else vertices
        base = self.base()
        if self.deformation is None:
            assert self.mesh_points is not None
            return compose_carried(self.mesh_points.points(vertices), self.mesh_points.turns(vertices), *base)
        values = self.deformation(self.active(self.code), self.condition(params, rotation, head_rotation))
        if on_gpu(values) and values.dtype == torch.float32 and self.is_fused:
            from avatar.gaussians.compose_gpu import compose_gpu  # imports Triton, which is not there on every machine

            grid = None if self.grid is None else self.grid.interpolate
            return compose_gpu(vertices, values, self.packed, *base, self.embedding, grid, self.skull_binding(params))
        if self.grid is not None:
            values = self.grid.interpolate(values)
        points = self.points(vertices, params)
        if self.ndgs is not None:
            return compose_slice(points, *base, *self.ndgs(values))
        if self.hyper is not None:
            values = self.hyper(values)
        return compose_raw(points, *base, values)

    def base(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Quaternions, log-scales, logits of the opacities and colours of the Gaussians that are alive."""
        sh = torch.cat((self.sh_dc, self.sh_rest), dim=1)
        quats, log_scales, opacity_logits, sh = map(self.active, (self.quats, self.log_scales, self.opacity_logits, sh))
        return quats, log_scales, opacity_logits, sh

    def active(self, values: Float[Tensor, "N ..."]) -> Float[Tensor, "alive ..."]:
        """Those of the points that are alive."""
        return values if self.count is None else values[: int(self.count)]

    def points(self, vertices: Float[Tensor, "V 3"], params: HeadParams) -> Float[Tensor, "alive 3"]:
        """Where the Gaussians are before their offsets, metres: on the posed mesh and, by a share, on the skull."""
        if self.mesh_points is not None:
            return self.active(self.mesh_points.points(vertices))
        return bind_to_skull(self.embedding.points(vertices), self.skull_binding(params))

    def skull_binding(self, params: HeadParams) -> SkullBinding | None:
        """What brings the Gaussians' points to the skull in a frame."""
        if self.skull is None or self.skull_logits is None:
            return None
        return SkullBinding(self.skull, params.neck, self.skull_logits)

    @property
    def skull_shares(self) -> Float[Tensor, " N"] | None:
        """The share in which each Gaussian keeps with the skull, in [0, 1]; None where none does."""
        return None if self.skull_logits is None else torch.sigmoid(self.skull_logits)

    def encode_points(self) -> None:
        """Give the network the places that points on the mesh have now."""
        if self.mesh_points is None or self.count is None:
            return
        vertices = self.mesh.neutral_vertices().to(self.code.device)
        self.code = positional_encoding(self.mesh_points.points(vertices).detach())

    def check_points(self) -> None:
        """After parameters were loaded. Raises ValueError for points that cannot be there."""
        if self.mesh_points is not None:
            self.mesh_points.check()
        if self.count is not None and not 1 <= int(self.count) <= len(self):
            raise ValueError(f"has {int(self.count)} points alive of {len(self)}")
        self.encode_points()

    @property
    def is_fused(self) -> bool:
        """Whether a GPU has kernels for all that follows the network; else torch's own operations do it there."""
        return self.ndgs is None and self.mesh_points is None and not isinstance(self.hyper, CovarianceHeads)

    @property
    def packed(self) -> Float[Tensor, "blocks rows 16"] | None:
        """The parameters of the HyperGaussian heads where they are held as `avatar.gaussians.hyper.pack` has them."""
        return self.hyper.packed if isinstance(self.hyper, HyperHeads) else None

    def vertices(self, params: HeadParams) -> Float[Tensor, "V 3"]:
        """The posed mesh where the avatar is, metres, the head model's vertices first; on a GPU without gradients."""
        device = self.code.device
        if not on_gpu(self.code):
            return self.mesh.vertices(params)
        if self._pose is None or self._pose.shape.device != device:
            self._pose = self.mesh.pose_tensors(device)
        if self._pose is None:
            return to_device(self.mesh.vertices(params.to(torch.device("cpu"))), device)
        from avatar.head.pose_gpu import pose_gpu

        return pose_gpu(self._pose, params.to(device))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Avatar:
        at_hand = self.turning if self._turning_at_hand is None else self._turning_at_hand
        super()._apply(fn, recurse)
        self._turning_at_hand = None if self.turning is None or self.turning.is_cpu else at_hand
        self.embedding.move(self.code.device)
        if self.skull is not None:
            self.skull.move(self.code.device)
        if self.grid is not None:
            self.grid.interpolate.move(self.code.device)
        return self

    def condition(
        self,
        params: HeadParams,
        rotation: Float[Tensor, "3 3"] | None = None,
        head_rotation: Float[Tensor, " 3"] | None = None,
    ) -> Float[Tensor, " D"]:
        """The network's input, with expression coefficients that the frame does not carry as zeros.

        rotation, head_rotation  as in `forward`
        """
        parts = [params.expression, params.jaw, params.eyes, params.eyelids]
        missing = self.head.assets.num_expressions - len(params.expression)
        if missing > 0:
            parts.insert(1, params.jaw.new_zeros(missing))
        if self.turning is not None:
            if head_rotation is None:
                head_rotation = params.jaw.new_zeros(VALUES) if rotation is None else self.head_rotation(rotation)
            parts.append(to_device(head_rotation, params.jaw.device))
        return to_device(torch.cat(parts), self.code.device)

    def head_rotation(self, rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 3"]:
        """The network's input for the head's rotation before a camera with this R_cam_world (`model.head_rotation`).

        Where `rotation` is, so that a camera on the CPU costs a GPU one copy.
        """
        assert self.turning is not None
        at_hand = self.turning if self._turning_at_hand is None else self._turning_at_hand
        return head_rotation_input(at_hand if rotation.is_cpu else self.turning, rotation)

    def learn_head_rotation(self, rotations: Float[Tensor, "T 3 3"]) -> None:
        """Before training: how heads are turned in its frames, whose R_cam_world these are."""
        if self.turning is not None:
            self.turning.copy_(learned_turning(rotations))
            self._keep_at_hand()

    def _keep_at_hand(self) -> None:
        """Have a copy of `turning` on the CPU where it is elsewhere."""
        turning = self.turning
        if turning is None or turning.is_cpu:
            self._turning_at_hand = None
        elif not turning.is_meta:
            self._turning_at_hand = turning.cpu()

    def draw(self, gaussians: Gaussians, camera: Camera, background: Float[Tensor, 3], **options: Any) -> Rendering:
        """`splat` with this avatar's blur; `options` as there."""
        return splat(gaussians, camera, background, **{"blur": self.config.blur, **options})


def _check_loaded(avatar: Avatar, _: object) -> None:
    avatar.check_points()
    avatar._keep_at_hand()
