"""A trained avatar's pictures as fast as possible: what never changes is computed once, and frames are drawn side by side.

`Renderer` gives what `avatar.draw(avatar(params, None, camera.head_rotation), camera, background)` gives, to rounding,
without autograd, where the avatar is. The avatar says what is computed once (`Avatar.frozen`): the first layer's product
with the positional code, the colours and, on a CPU, each HyperGaussian, which for inference is an affine map of its latent:
n multiply-adds for each of ten offsets remain. On a GPU the launches count: one does all that follows the network, and a
frame is replayed as a CUDA graph where its camera's intrinsics have been seen before.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.cuda_graph import Downloads, Replay, new_pool, own_stream
from avatar.compute.device import on_gpu, to_device
from avatar.compute.workers import in_order
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.splat import CannotDraw, checked_drawings, is_checked
from avatar.splat.cpu import thread_count
from avatar.types import Camera, Gaussians, HeadParams, Rendering

AHEAD_ON_GPU = 3  # frames whose copies are on their way
WARM = 2  # frames of a kind that are launched before: they compile, and make what is made once
KEPT = 16  # kinds that are ready at a time
_PARAMS = tuple(field.name for field in fields(HeadParams))


class _Kind(NamedTuple):
    """Frames that launch the same."""

    expressions: int
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    is_reference: bool

    @classmethod
    def of(cls, params: HeadParams, camera: Camera) -> _Kind:
        c = camera
        is_reference = c.R_ref_cam is None
        return cls(len(params.expression), c.width, c.height, c.fx, c.fy, c.cx, c.cy, is_reference)


class Renderer:
    """Renders one avatar over one background. Holds a copy of the parameters: later training does not show.

    Any number of threads may use one renderer.
    """

    @torch.no_grad()
    def __init__(self, avatar: Avatar, background: Float[Tensor, " 3"]) -> None:
        self.background = to_device(background.detach().clone(), avatar.device)
        self.avatar = avatar.frozen()
        self._replays = avatar.is_replayable and on_gpu(self.background) and not self.background.is_meta
        self._kinds: OrderedDict[_Kind, int | Replay[Tensor]] = OrderedDict()  # how many were launched, or a replay
        self._pool = new_pool(self.background.device)
        self._lock = threading.Lock()  # of the replays' buffers
        self._read: torch.cuda.Event | None = None  # when what the last one gave has been

    @torch.no_grad()
    def gaussians(self, params: HeadParams, camera: Camera | None = None) -> Gaussians:
        """What `avatar(params)` gives, to rounding, as the head is turned before the camera where one is given."""
        return self.avatar(params, None, None if camera is None else camera.head_rotation)

    @torch.no_grad()
    def render(self, params: HeadParams, camera: Camera) -> Rendering:
        """One frame as soon as possible: each step uses all threads."""
        packed = self._replayed(params, camera)
        if packed is not None:
            rendering = unpacked(packed, camera)
            if not (is_checked(self.background.device) and is_nan(rendering)):
                return rendering
        return self.draw(self.gaussians(params, camera), camera, self.background)

    def _replayed(self, params: HeadParams, camera: Camera) -> Float[Tensor, " P"] | None:
        """The frame, `packed`, by a replay; None: it has to be launched."""
        if not self._replays:
            return None
        kind = _Kind.of(params, camera)
        with self._lock:
            known = self._kinds.pop(kind, 0)
            if len(self._kinds) >= KEPT:
                self._kinds.popitem(last=False)
            if not isinstance(known, Replay) and known < WARM:
                self._kinds[kind] = known + 1
                return None
            parts = [*(getattr(params, name) for name in _PARAMS), camera.R_cam_world, camera.t_cam_world]
            parts += [] if camera.R_ref_cam is None else [camera.R_ref_cam]
            inputs = {"parts": to_device(torch.cat([part.float().flatten() for part in parts]), self.background.device)}
            if not isinstance(known, Replay):
                try:
                    known = self._captured(camera, inputs, [part.shape for part in parts])
                except CannotDraw:  # a launched frame says why
                    return None
                except RuntimeError:
                    self._replays = False
                    return None
            self._kinds[kind] = known
            if self._read is not None:
                torch.cuda.current_stream(self.background.device).wait_event(self._read)
            frame = known(inputs).clone()
            if self.background.is_cuda:
                self._read = torch.cuda.Event()
                self._read.record()
            return frame

    def _captured(self, camera: Camera, inputs: Mapping[str, Tensor], shapes: Sequence[torch.Size]) -> Replay[Tensor]:
        def play(named: Mapping[str, Tensor]) -> Tensor:
            flat = named["parts"].split([shape.numel() for shape in shapes])
            values = [part.view(shape) for part, shape in zip(flat, shapes, strict=True)]
            params = HeadParams(**dict(zip(_PARAMS, values, strict=False)))
            R, t, *turn = values[len(_PARAMS) :]
            seen = replace(camera, R_cam_world=R, t_cam_world=t, R_ref_cam=turn[0] if turn else None)
            with checked_drawings(False):
                return packed(self.avatar.draw(self.gaussians(params, seen), seen, self.background))

        with own_stream(self.background.device):
            play({name: part.clone() for name, part in inputs.items()})
            return Replay(play, inputs, self._pool)

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
        pending: deque[tuple[tuple[HeadParams, Camera], Tensor, torch.cuda.Event]] = deque()
        downloads = Downloads(self.background.device)
        for params, camera in frames:
            frame = self._replayed(params, camera)
            if frame is None:
                frame = packed(self.render(params, camera))
            pending.append(((params, camera), *downloads.begin(frame)))
            if len(pending) > AHEAD_ON_GPU:
                yield self._arrived(*pending.popleft())
        while pending:
            yield self._arrived(*pending.popleft())

    def _arrived(self, frame: tuple[HeadParams, Camera], copy: Tensor, arrived: torch.cuda.Event) -> Rendering:
        arrived.synchronize()
        rendering = unpacked(copy, frame[1])
        if is_nan(rendering):
            with checked_drawings():
                self.render(*frame)  # raises what is wrong
        return rendering


def packed(rendering: Rendering) -> Float[Tensor, " P"]:
    """Image, then alpha: one thing to copy."""
    return torch.cat([part.flatten() for part in rendering])


def unpacked(values: Float[Tensor, " P"], camera: Camera) -> Rendering:
    size = camera.height, camera.width
    image, alpha = values.split([3 * size[0] * size[1], size[0] * size[1]])
    return Rendering(image.view(*size, 3), alpha.view(size))


def is_nan(rendering: Rendering) -> bool:
    """Whether a GPU could not draw it: then every pixel is NaN. Waits for it."""
    return math.isnan(float(rendering.alpha[0, 0]))
