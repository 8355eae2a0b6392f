"""One training step cut into stages, each timed forward and backward by itself on the values that a real step gives it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from torch import Tensor

from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.gaussians.skull_binding import bind_to_skull
from avatar.losses.photometric import PhotometricLoss
from avatar.model import FlashAvatar
from avatar.train.optimizer import schedule, set_rates
from avatar.train.step import TrainState, check_step, gradients_of
from avatar.types import Frame, Gaussians


@dataclass
class Stopwatch:
    """Milliseconds by stage, one value a step."""

    spans: dict[str, list[float]] = field(default_factory=dict)

    def measure(self, stage: str, function: Callable[[], Any]) -> Any:
        begin = time.perf_counter()
        result = function()
        self.spans.setdefault(stage, []).append(1e3 * (time.perf_counter() - begin))
        return result


@dataclass
class Link:
    """A stage that has run forward: its inputs, cut off from what made them, and its outputs."""

    name: str
    inputs: list[Tensor]
    outputs: list[Tensor]


class StagedStep:
    """A training step of `avatar`, stage by stage: the operations of `train_step`, without pose corrections."""

    def __init__(self, state: TrainState) -> None:
        self.avatar, self.optimizer, self.objective = with_stages(state.avatar), state.optimizer, state.objective
        self.watch = Stopwatch()
        self._chain: list[Link] = []

    def __call__(self, step: int, make_frame: Callable[[], Frame]) -> PhotometricLoss:
        """One whole step with its update. `make_frame` decodes or fetches the frame, which is the stage `frame`."""
        avatar, objective, watch = self.avatar, self.objective, self.watch
        self._chain.clear()
        frame = watch.measure("frame", make_frame)
        target = watch.measure("target", lambda: frame.composite(objective.background))
        vertices = watch.measure("skinning", lambda: avatar.mesh.vertices(frame.params))
        points = watch.measure("embedding", lambda: avatar.embedding.points(vertices))
        condition = avatar.condition(frame.params, frame.camera.R_cam_world)

        network = avatar.deformation
        (raw,) = self._forward("network", lambda: (network(avatar.code, condition),), [], list(network.parameters()))
        if avatar.grid is not None:
            (raw,) = self._forward("interpolation", lambda z: (avatar.interpolate(z),), [raw])
        if avatar.hyper is not None:
            (raw,) = self._forward("heads", lambda z: (avatar.offsets(z),), [raw], list(avatar.hyper.parameters()))
        base = [avatar.quats, avatar.log_scales, avatar.opacity_logits, avatar.sh_dc, avatar.sh_rest]
        skull_binding = avatar.skull_binding(frame.params)
        gaussians = self._forward(
            "compose",
            lambda z: avatar.compose(bind_to_skull(points, skull_binding), z),
            [raw],
            base if avatar.skull_logits is None else [*base, avatar.skull_logits],
        )
        (image,) = self._forward(
            "splat", lambda *g: (objective.draw(step, Gaussians(*g), frame.camera, avatar),), list(gaussians)
        )
        loss: list[PhotometricLoss] = []

        def compare(picture: Tensor) -> tuple[Tensor]:
            loss.append(objective.loss(step, frame, picture, target))
            return (loss[0].total,)

        self._forward("loss", compare, [image])
        watch.measure("backward: clearing", self.optimizer.zero_grad)
        self._backward()
        watch.measure("check", lambda: check_step(step, frame, loss[0], gradients_of(avatar)))
        set_rates(self.optimizer, schedule(step, objective.config))
        watch.measure("optimizer", self.optimizer.step)
        return loss[0]

    def _forward(
        self,
        name: str,
        function: Callable[..., Sequence[Tensor]],
        inputs: Sequence[Tensor],
        parameters: Sequence[Tensor] = (),
    ) -> list[Tensor]:
        cut = [tensor.detach().requires_grad_() for tensor in inputs]
        outputs = list(self.watch.measure(name, lambda: function(*cut)))
        self._chain.append(Link(name, [*cut, *parameters], outputs))
        return outputs

    def _backward(self) -> None:
        """From the loss back to the network: each stage's cotangents are the next one's gradients of its inputs."""
        cotangents = [torch.ones(())]
        for link in reversed(self._chain):
            found = self.watch.measure(
                f"{link.name}, backward",
                lambda link=link: gradients(link, cotangents),  # noqa: B023 (called at once)
            )
            cotangents = []
            for tensor, gradient in zip(link.inputs, found, strict=True):
                if isinstance(tensor, torch.nn.Parameter):
                    tensor.grad = gradient
                else:
                    cotangents.append(gradient)


def with_stages(avatar: Avatar) -> FlashAvatar:
    """Raises UserError for an avatar whose steps are others than the stages that are timed."""
    if not avatar.has_stages:
        raise UserError(f"the stages of a step of model={avatar.config.name} are not timed; choose another model")
    return cast(FlashAvatar, avatar)


def gradients(link: Link, cotangents: Sequence[Tensor]) -> list[Tensor]:
    """Of a stage's inputs; laid out densely, as `backward` leaves them and the fused optimizer needs them."""
    return [found.contiguous() for found in torch.autograd.grad(link.outputs, link.inputs, cotangents)]
