"""One step of the optimisation: draw a frame, compare, differentiate, check, update.

`train_step` is one function of named tensors: a CPU calls it, a GPU captures it (`avatar.train.step_runner`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from avatar.data.frame import Frame
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.losses.photometric import PhotometricLoss
from avatar.splat import CannotDraw
from avatar.tensors import describe_non_finite
from avatar.train.loss import TrainingLoss, sh_degree
from avatar.train.pose_corrections import PoseCorrections
from avatar.types import HeadParams

GradientCheck = Callable[[PhotometricLoss, list[Tensor]], None]  # given the loss and all gradients before the update

_IMAGES = ("image", "alpha", "head_mask", "mouth_mask")
_OPTIONAL = ("noise", "row", "pose_jacobian", "crop_rows", "crop_columns")
_PARAMS = tuple(field.name for field in fields(HeadParams))


class StepInputs(NamedTuple):
    """One training frame as a step takes it; all tensors are where the avatar is."""

    frame: Frame
    vertices: Float[Tensor, "V 3"]  # posed by the frame's parameters, metres
    background: Float[Tensor, "3"]  # behind the rendered and the true head
    noise: Float[Tensor, " C"] | None = None  # added to the network's input
    row: Int[Tensor, "1"] | None = None  # of the frame among the pose corrections
    pose_jacobian: Float[Tensor, "5 12"] | None = None  # of the frame's camera in its correction
    crop_rows: Int[Tensor, " h"] | None = None  # of the frame, which the perceptual term sees
    crop_columns: Int[Tensor, " w"] | None = None

    def tensors(self) -> dict[str, Tensor]:
        """All that differs between two steps, by name."""
        frame, camera = self.frame, self.frame.camera
        named = {name: getattr(frame, name) for name in _IMAGES} | {"R": camera.R_cam_world, "t": camera.t_cam_world}
        named |= {name: getattr(frame.params, name) for name in _PARAMS}
        named |= {} if camera.R_ref_cam is None else {"R_ref_cam": camera.R_ref_cam}
        optional = {name: getattr(self, name) for name in _OPTIONAL}
        required = {"vertices": self.vertices, "background": self.background}
        return named | required | {n: value for n, value in optional.items() if value is not None}

    def with_tensors(self, named: Mapping[str, Tensor]) -> StepInputs:
        """The same with other `tensors`."""
        camera = replace(
            self.frame.camera, R_cam_world=named["R"], t_cam_world=named["t"], R_ref_cam=named.get("R_ref_cam")
        )
        params = HeadParams(**{name: named[name] for name in _PARAMS})
        frame = replace(self.frame, camera=camera, params=params, **{name: named[name] for name in _IMAGES})
        return StepInputs(
            frame, named["vertices"], named["background"], **{name: named.get(name) for name in _OPTIONAL}
        )


class StepOutputs(NamedTuple):
    """What a step saw and what it cost, before its update; without a graph."""

    loss: PhotometricLoss
    render: Float[Tensor, "H W 3"]
    target: Float[Tensor, "H W 3"]


@dataclass(frozen=True)
class TrainState:
    """What is trained, how, and on what loss."""

    avatar: Avatar
    optimizer: torch.optim.Adam
    objective: TrainingLoss
    pose_corrections: PoseCorrections | None = None

    def named_parameters(self) -> dict[str, nn.Parameter]:
        named = dict(self.avatar.named_parameters())
        if self.pose_corrections is not None:
            named |= {f"pose_corrections.{name}": p for name, p in self.pose_corrections.named_parameters()}
        return named


def train_step(
    state: TrainState, step: int, inputs: StepInputs, check_gradients: GradientCheck | None = None
) -> StepOutputs:
    """Step number `step` (from 0) at the optimizer's rates.

    Raises UserError, leaving the parameters as they were, when the Gaussians cannot be drawn or when the loss or a gradient
    is not finite; with `check_gradients` it handles the latter.
    """
    avatar, objective, frame = state.avatar, state.objective, inputs.frame
    target = frame.composite(inputs.background)
    params, camera = frame.params, frame.camera
    if inputs.noise is not None:
        params = params.with_condition(params.condition() + inputs.noise)
    if state.pose_corrections is not None:
        camera = state.pose_corrections(camera, inputs.row, inputs.pose_jacobian)
    try:
        gaussians = avatar(params, inputs.vertices, camera.head_rotation.detach())
        image, *smaller = avatar.training_images(gaussians, camera, inputs.background, sh_degree(step))
    except CannotDraw as error:
        raise non_finite_error(step + 1, frame, str(error)) from error
    crop = None
    if inputs.crop_rows is not None and inputs.crop_columns is not None:
        crop = inputs.crop_rows, inputs.crop_columns
    loss = objective.loss(step, frame, image, target, crop, smaller)
    state.optimizer.zero_grad()
    loss.total.backward()
    gradients = gradients_of(state)
    if check_gradients is None:
        check_step(step, frame, loss, gradients)
    else:
        check_gradients(loss, list(gradients.values()))
    state.optimizer.step()
    return StepOutputs(PhotometricLoss(*(term.detach() for term in loss)), image.detach(), target)


def gradients_of(module: TrainState | nn.Module) -> dict[str, Tensor]:
    """By the parameter's name, of those that have one."""
    return {name: p.grad for name, p in dict(module.named_parameters()).items() if p.grad is not None}


def check_step(step: int, frame: Frame, loss: PhotometricLoss, gradients: Mapping[str, Tensor]) -> None:
    """Stop before the optimizer when the loss or a gradient is not finite, naming the step, the frame and the tensor."""
    norm = nn.utils.get_total_norm(gradients.values())
    if bool(torch.isfinite(norm + loss.total.detach())):
        return
    suspects = {f"the loss term {n}": v for n, v in loss._asdict().items()}
    suspects |= {f"the gradient of {n}": g for n, g in gradients.items()}
    for name, tensor in suspects.items():
        if message := describe_non_finite(name, tensor.detach()):
            raise non_finite_error(step + 1, frame, message)
    # Every value is finite but a norm overflows float32: as useless to Adam as a NaN.
    largest = max(gradients, key=lambda name: float(gradients[name].abs().max()))
    raise non_finite_error(step + 1, frame, f"the norm of the gradient of {largest} is beyond float32")


def non_finite_error(step: int, frame: Frame, problem: str) -> UserError:
    """What is said when the parameters have left what can be computed with; `step` counts from 1."""
    return UserError(
        f"training stopped at step {step}, frame {frame.name}: {problem}; what was saved before is untouched. Train "
        "again into another --out with lower trainer.learning_rates, or without that frame"
    )
