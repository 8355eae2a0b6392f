"""A trained avatar's pictures as fast as possible: what never changes is computed once, and frames are drawn side by side.

`Renderer` gives what `avatar.draw(avatar(params, None, camera.head_rotation), camera, background)` gives, to rounding,
without autograd, where the avatar is. The avatar says what is computed once (`Avatar.frozen`): the first layer's product
with the positional code, the colours and, on a CPU, each HyperGaussian, which for inference is an affine map of its latent:
n multiply-adds for each of ten offsets remain. On a GPU the launches count, and one does all that follows the network.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import on_gpu, to_device
from avatar.compute.workers import in_order
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.splat import CannotDraw, checked_drawings
from avatar.splat.cpu import thread_count
from avatar.types import Camera, Gaussians, HeadParams, Rendering

AHEAD_ON_GPU = 3  # frames whose copies are on their way


class Renderer:
    """Renders one avatar over one background. Holds a copy of the parameters: later training does not show.

    Any number of threads may use one renderer.
    """

    @torch.no_grad()
    def __init__(self, avatar: Avatar, background: Float[Tensor, " 3"]) -> None:
        self.background = to_device(background.detach().clone(), avatar.device)
        self.avatar = avatar.frozen()

    @torch.no_grad()
    def gaussians(self, params: HeadParams, camera: Camera | None = None) -> Gaussians:
        """What `avatar(params)` gives, to rounding, as the head is turned before the camera where one is given."""
        return self.avatar(params, None, None if camera is None else camera.head_rotation)

    @torch.no_grad()
    def render(self, params: HeadParams, camera: Camera) -> Rendering:
        """One frame as soon as possible: each step uses all threads."""
        return self.draw(self.gaussians(params, camera), camera, self.background)

    def draw(self, gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"]) -> Rendering:
        """The avatar's Gaussians, with a sentence where its parameters are beyond what can be drawn (UserError)."""
        try:
            return self.avatar.draw(gaussians, camera, background)
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
        if workers == 1 or on_gpu(self.background):
            yield from (self.render(*frame) for frame in frames)
            return
        yield from in_order(lambda frame: self.render(*frame), frames, workers)

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
