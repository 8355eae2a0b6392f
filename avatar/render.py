"""A trained avatar's pictures as fast as possible: what never changes is computed once, and frames are drawn side by side.

`Renderer` gives what `avatar.draw(avatar(params, None, camera.R_cam_world), camera, background)` gives, to rounding,
without autograd, where the avatar is.
Computed once: the first layer's product with the positional code, the colours and, on a CPU, each HyperGaussian, which for
inference is an affine map of its latent: n multiply-adds for each of ten offsets remain. On a GPU the launches count, and
one does all that follows the network.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from copy import deepcopy

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import embedding_bag

from avatar.compute.device import on_gpu, to_device
from avatar.compute.workers import single_threaded_workers
from avatar.errors import UserError
from avatar.gaussians.compose import compose_carried, compose_raw, compose_slice
from avatar.gaussians.deformation import DeformationMLP
from avatar.gaussians.ndgs import Slice
from avatar.gaussians.skull_binding import SkullBinding, bind_to_skull
from avatar.model import Avatar
from avatar.splat import CannotDraw
from avatar.splat.cpu import thread_count
from avatar.splat.gpu_buffers import checked_drawings
from avatar.types import Camera, Gaussians, HeadParams, Rendering

AHEAD_PER_WORKER = 2  # frames begun before the first of them is asked for
AHEAD_ON_GPU = 3  # frames whose copies are on their way


class Renderer:
    """Renders one avatar over one background. Holds a copy of the parameters: later training does not show.

    Any number of threads may use one renderer.
    """

    @torch.no_grad()
    def __init__(self, avatar: Avatar, background: Float[Tensor, " 3"]) -> None:
        self.background = to_device(background.detach().clone(), avatar.code.device)
        self._avatar = avatar
        self._network = None if avatar.deformation is None else FoldedNetwork(avatar, avatar.deformation)
        self._on_gpu = on_gpu(avatar.code) and avatar.is_fused
        self._heads = None if avatar.hyper is None or self._on_gpu else avatar.hyper.fold()
        self._packed = avatar.packed.detach().clone() if self._on_gpu and avatar.packed is not None else None
        self._ndgs, self._mesh_points = deepcopy(avatar.ndgs), deepcopy(avatar.mesh_points)
        self._skull_logits = deepcopy(avatar.skull_logits)
        names = ("quats", "log_scales", "opacity_logits", "sh")
        self._base = {name: value.detach().clone() for name, value in zip(names, avatar.base(), strict=True)}

    @torch.no_grad()
    def gaussians(self, params: HeadParams, camera: Camera | None = None) -> Gaussians:
        """What `avatar(params)` gives, to rounding, as the head is turned before the camera where one is given."""
        if self._network is None:
            assert self._mesh_points is not None
            vertices = self.vertices(params)
            return compose_carried(self.points(vertices, params), self._mesh_points.turns(vertices), **self._base)
        if self._on_gpu:
            from avatar.gaussians.compose_gpu import compose_gpu  # imports Triton, which is not there on every machine

            avatar, grid = self._avatar, self._avatar.grid
            values = self._network(avatar.condition(params, rotation_of(camera)))
            return compose_gpu(
                self.vertices(params),
                values,
                self._packed,
                **self._base,
                embedding=avatar.embedding,
                grid=None if grid is None else grid.interpolate,
                skull_binding=self._skull_binding(params),
            )
        return self.place(self.points(self.vertices(params), params), self.offsets(self.latents(params, camera)))

    @torch.no_grad()
    def render(self, params: HeadParams, camera: Camera) -> Rendering:
        """One frame as soon as possible: each step uses all threads."""
        return self.draw(self.gaussians(params, camera), camera, self.background)

    def draw(self, gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"]) -> Rendering:
        """The avatar's Gaussians, with a sentence where its parameters are beyond what can be drawn (UserError)."""
        try:
            return self._avatar.draw(gaussians, camera, background)
        except CannotDraw as error:
            raise UserError(
                f"this frame cannot be drawn: {error}; its coefficients are out of range or, where no frame can be drawn, "
                "the training has gone wrong: train again with lower trainer.learning_rates"
            ) from error

    def stream(self, frames: Iterable[tuple[HeadParams, Camera]]) -> Iterator[Rendering]:
        """Many frames in order, as many per second as possible: each is drawn by one thread, several at a time.

        `frames` may be endless; a few of them are taken ahead. An exception of a frame is raised when its turn comes. The
        pictures are on the CPU; a GPU draws the next ones while one is copied.
        """
        if self.background.is_cuda:
            yield from self._stream_from_gpu(frames)
            return
        workers = thread_count()
        if workers == 1 or self._on_gpu:
            yield from (self.render(*frame) for frame in frames)
            return
        source = iter(frames)
        pending: deque[Future[Rendering]] = deque()
        with single_threaded_workers(workers) as pool:
            try:
                while True:
                    while len(pending) < AHEAD_PER_WORKER * workers and (frame := next(source, None)) is not None:
                        pending.append(pool.submit(self.render, *frame))
                    if not pending:
                        return
                    yield pending.popleft().result()
            finally:
                for future in pending:
                    future.cancel()

    def _stream_from_gpu(self, frames: Iterable[tuple[HeadParams, Camera]]) -> Iterator[Rendering]:
        pending: deque[tuple[tuple[HeadParams, Camera], Rendering, torch.cuda.Event]] = deque()
        for frame in frames:
            copies = Rendering(*(t.to("cpu", non_blocking=True) for t in self.render(*frame)))
            arrived = torch.cuda.Event()
            arrived.record()
            pending.append((frame, copies, arrived))
            if len(pending) > AHEAD_ON_GPU:
                yield self._arrived(*pending.popleft())
        while pending:
            yield self._arrived(*pending.popleft())

    def _arrived(self, frame: tuple[HeadParams, Camera], copies: Rendering, arrived: torch.cuda.Event) -> Rendering:
        arrived.synchronize()
        if bool(copies.alpha.isnan().any()):
            with checked_drawings():
                self.render(*frame)  # raises what is wrong
        return copies

    # The steps of `gaussians`, apart so that they can be timed; without autograd where their caller is.

    def vertices(self, params: HeadParams) -> Float[Tensor, "V 3"]:
        """The posed mesh, metres."""
        return self._avatar.vertices(params)

    def points(self, vertices: Float[Tensor, "V 3"], params: HeadParams) -> Float[Tensor, "N 3"]:
        """Where the Gaussians are before their offsets, metres: on the posed mesh and, by a share, on the skull."""
        if self._mesh_points is not None:
            return self._mesh_points.points(vertices)[: len(self._base["quats"])]
        embedding = self._avatar.embedding
        points = embedding_bag(embedding.corners, vertices, mode="sum", per_sample_weights=embedding.barycentric)
        return bind_to_skull(points, self._skull_binding(params))

    def _skull_binding(self, params: HeadParams) -> SkullBinding | None:
        skull_binding = self._avatar.skull_binding(params)
        return (
            None
            if skull_binding is None or self._skull_logits is None
            else skull_binding._replace(logits=self._skull_logits)
        )

    def latents(self, params: HeadParams, camera: Camera | None = None) -> Float[Tensor, "N n"]:
        """The network's output for each Gaussian, as in `gaussians`. Raises ValueError for an avatar without a network."""
        if self._network is None:
            raise ValueError(f"model={self._avatar.config.name} has no network")
        latents, grid = self._network(self._avatar.condition(params, rotation_of(camera))), self._avatar.grid
        if grid is None:
            return latents
        return grid.interpolate(latents)

    def offsets(self, latents: Float[Tensor, "N n"]) -> Float[Tensor, "N 10"] | Slice:
        """The ten values of each Gaussian before the tanh, or its slice of an N-dimensional one; the latents themselves
        where there is neither."""
        if self._ndgs is not None:
            return self._ndgs(latents)
        return latents if self._heads is None else self._heads(latents)

    def place(self, points: Float[Tensor, "N 3"], offsets: Float[Tensor, "N 10"] | Slice) -> Gaussians:
        if isinstance(offsets, Slice):
            return compose_slice(points, **self._base, position=offsets.position, density=offsets.density)
        return compose_raw(points, raw=offsets, **self._base)


def rotation_of(camera: Camera | None) -> Float[Tensor, "3 3"] | None:
    return None if camera is None else camera.R_cam_world


class FoldedNetwork:
    """The deformation network with the first layer's product with the code done; `avatar.deformation` to rounding."""

    def __init__(self, avatar: Avatar, network: DeformationMLP) -> None:
        for_code, for_condition = network.input.weight.detach().split((network.code_size, network.condition_size), 1)
        self._of_code: Float[Tensor, "M width"] = avatar.active(avatar.code) @ for_code.T
        self._for_condition, self._bias = for_condition.clone(), network.input.bias.detach().clone()
        self._layers = [
            (layer.get_parameter("weight").detach().T.clone(), layer.get_parameter("bias").detach().clone())
            for layer in (*network.hidden, network.output)
        ]
        self._buffers = threading.local()  # activations are megabytes: fresh memory every frame would cost page faults

    def __call__(self, condition: Float[Tensor, " D"]) -> Float[Tensor, "M n"]:
        of_frame = torch.addmv(self._bias, self._for_condition, condition)
        if not hasattr(self._buffers, "pair"):
            self._buffers.pair = torch.empty_like(self._of_code), torch.empty_like(self._of_code)
        x, spare = self._buffers.pair
        torch.add(self._of_code, of_frame, out=x).relu_()
        for weight, bias in self._layers[:-1]:
            torch.addmm(bias, x, weight, out=spare).relu_()
            x, spare = spare, x
        weight, bias = self._layers[-1]
        return torch.addmm(bias, x, weight)
