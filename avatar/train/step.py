"""One step of the optimisation: draw a frame, compare, differentiate, check, move."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import CPU
from avatar.config import TrainerConfig
from avatar.errors import UserError
from avatar.gaussians.avatar import SH_DEGREE, Avatar
from avatar.losses.lpips import MissingWeights, load_lpips
from avatar.losses.lpips_network import MIN_SIZE
from avatar.losses.metrics import SSIM_WINDOW
from avatar.losses.photometric import (
    LPIPS_WEIGHT,
    Perceptual,
    PhotometricLoss,
    dssim,
    masked_lpips,
    on_head,
    photometric_loss,
)
from avatar.splat import CannotDraw
from avatar.tensors import describe_non_finite
from avatar.train.optimizer import schedule, set_rates
from avatar.types import Frame, Gaussians

SH_INTERVAL = 500  # steps after which one more spherical-harmonics degree takes part
PERCEPTUAL_START = 0.5  # share of the steps after which the perceptual term takes part (15,000 of 30,000)
SPARSE_EVERY = 10  # LPIPS takes part in every so many-th step, with so many times the weight, where it is sparse

Judge = Callable[[PhotometricLoss, list[Tensor]], None]  # given the loss and all gradients before the update


class Weighted(NamedTuple):
    function: Perceptual
    weight: float
    crops: bool = False  # to the head's box, which it takes as `box` where it is known


@dataclass(frozen=True)
class PerceptualTerm:
    """What the third term of the loss is in this run."""

    name: str
    term: Weighted | None = None
    every: int = 1  # takes part in every so many-th step, with so many times the weight
    between: Weighted | None = None  # stands in for it in the other steps
    before: Weighted | None = None  # stands in for it in steps before its first

    def at(self, step: int, start: int) -> Weighted | None:
        """The term of step `step` (from 0) when there is one from step `start` on."""
        if self.term is None:
            return None
        if step < start:
            return self.before
        if (step - start) % self.every:
            return self.between
        return self.term._replace(weight=self.term.weight * self.every)


class Outcome(NamedTuple):
    """What a step saw and what it cost, before its update; without a graph."""

    loss: PhotometricLoss
    render: Float[Tensor, "H W 3"]
    target: Float[Tensor, "H W 3"]


def sh_degree(step: int) -> int:
    """The degree of the view-dependent colour that takes part in step `step` (from 0)."""
    return min(step // SH_INTERVAL, SH_DEGREE)


def perceptual_start(config: TrainerConfig) -> int:
    """The first step (from 0) in which the perceptual term takes part."""
    return round(PERCEPTUAL_START * config.iterations)


@dataclass(frozen=True)
class Objective:
    """What a step minimises, for any frame."""

    config: TrainerConfig
    background: Float[Tensor, 3]
    perceptual: PerceptualTerm

    def term(self, step: int) -> Weighted | None:
        """The third term of step `step`."""
        return self.perceptual.at(step, perceptual_start(self.config))

    def loss(self, step: int, frame: Frame, image: Float[Tensor, "H W 3"], target: Tensor) -> PhotometricLoss:
        term = self.term(step)
        function = partial(term.function, box=frame.head_box) if term and term.crops else term and term.function
        return photometric_loss(
            image,
            target,
            frame.mouth_mask,
            frame.head_mask,
            perceptual=function,
            perceptual_weight=term.weight if term else 0.0,
        )

    def draw(self, step: int, frame: Frame, gaussians: Gaussians, avatar: Avatar) -> Float[Tensor, "H W 3"]:
        return avatar.draw(gaussians, frame.camera, self.background, sh_degree=sh_degree(step)).image


def training_step(
    avatar: Avatar,
    optimizer: torch.optim.Adam,
    objective: Objective,
    step: int,
    frame: Frame,
    vertices: Float[Tensor, "V 3"],
    judge: Judge | None = None,
    watched: Callable[[Gaussians], Gaussians] | None = None,
) -> Outcome:
    """Step number `step` (from 0) on one frame, whose posed mesh is `vertices`; drawn are `watched` of its Gaussians.

    Raises UserError, leaving the parameters as they were, when the Gaussians cannot be drawn or when the loss or a gradient
    is not finite; with a `judge` the latter is for it to see to.
    """
    set_rates(optimizer, schedule(step, objective.config))
    outcome = descend(avatar, optimizer, objective, step, frame, vertices, judge, watched)
    avatar.after_step(optimizer, step + 1, objective.config)
    return outcome


def descend(
    avatar: Avatar,
    optimizer: torch.optim.Adam,
    objective: Objective,
    step: int,
    frame: Frame,
    vertices: Float[Tensor, "V 3"],
    judge: Judge | None = None,
    watched: Callable[[Gaussians], Gaussians] | None = None,
    head_rotation: Float[Tensor, " 3"] | None = None,
) -> Outcome:
    """What of `training_step` a GPU does by itself, at the optimizer's rates; `head_rotation` as in `Avatar.forward`."""
    target = frame.composite(objective.background)
    try:
        gaussians = avatar(frame.params, vertices, frame.camera.R_cam_world, head_rotation=head_rotation)
        gaussians = gaussians if watched is None else watched(gaussians)
        image = objective.draw(step, frame, gaussians, avatar)
    except CannotDraw as error:
        raise stopped(step + 1, frame, str(error)) from error
    loss = objective.loss(step, frame, image, target)
    optimizer.zero_grad()
    loss.total.backward()
    if judge is None:
        check_step(step, frame, loss, avatar)
    else:
        judge(loss, [parameter.grad for parameter in avatar.parameters() if parameter.grad is not None])
    optimizer.step()
    return Outcome(PhotometricLoss(*(term.detach() for term in loss)), image.detach(), target)


def choose_perceptual(
    config: TrainerConfig,
    say: Callable[[str], None],
    recorded: str | None = None,
    *,
    size: tuple[int, int] | None = None,
    device: torch.device = CPU,
) -> PerceptualTerm:
    """LPIPS, D-SSIM or nothing. `auto` takes LPIPS when its weights are on this machine, else D-SSIM, and says so.

    `recorded` is the name of what a run began with, which it keeps whatever this machine has. `size` is that of the frames
    (width, height), where it is known: LPIPS needs 32 pixels a side, SSIM 11. Raises UserError when LPIPS is asked for by
    name, or recorded, and cannot be had, and for frames that are too small.
    """
    if size is not None and min(size) < SSIM_WINDOW:
        raise UserError(too_small("SSIM, which training and evaluation compare by,", SSIM_WINDOW, size))
    if config.perceptual == "none":
        return PerceptualTerm("none")
    in_its_place = Weighted(dssim, config.dssim_weight)
    before = Weighted(dssim, config.dssim_early) if config.dssim_early else None
    lpips_name = f"lpips-{config.lpips_net}"
    if config.perceptual in ("lpips", "auto") and recorded in (None, lpips_name):
        try:
            if size is not None and min(size) < MIN_SIZE:
                raise UserError(too_small("LPIPS", MIN_SIZE, size))
            lpips = load_lpips(config.lpips_net, download=config.perceptual == "lpips").on(device)
            crops = config.sparse_lpips
            function = on_head(masked_lpips(lpips)) if crops else masked_lpips(lpips)
            every = SPARSE_EVERY if config.sparse_lpips else 1
            return PerceptualTerm(lpips_name, Weighted(function, LPIPS_WEIGHT, crops), every, in_its_place, before)
        except UserError as error:
            if recorded is not None:
                raise UserError(f"the run began with LPIPS and cannot go on without it: {error}") from None
            if config.perceptual == "lpips":
                raise UserError(
                    f"{error}. This configuration trains with LPIPS (trainer.perceptual=lpips); trainer.perceptual=dssim "
                    "trains without, and its figures do not compare"
                ) from None
            said = error.brief if isinstance(error, MissingWeights) else error
            say(f"Training with D-SSIM in place of LPIPS: {said}")
    return PerceptualTerm("dssim", in_its_place, before=before)


def too_small(term: str, side: int, size: tuple[int, int]) -> str:
    width, height = size
    enough = math.ceil(side * max(1.0, width / (height - 0.5)))  # the height is rounded
    return (
        f"{term} needs frames of at least {side}x{side} pixels, these have {width}x{height}; train with --size {enough} or "
        "more"
    )


def check_step(step: int, frame: Frame, loss: PhotometricLoss, avatar: Avatar) -> None:
    """Stop before the optimizer when the loss or a gradient is not finite, naming the step, the frame and the tensor."""
    gradients: dict[str, Tensor] = {n: p.grad for n, p in avatar.named_parameters() if p.grad is not None}
    norm = torch.nn.utils.get_total_norm(gradients.values())
    if bool(torch.isfinite(norm + loss.total.detach())):
        return
    suspects = {f"the loss term {n}": v for n, v in loss._asdict().items()}
    suspects |= {f"the gradient of {n}": g for n, g in gradients.items()}
    for name, tensor in suspects.items():
        if message := describe_non_finite(name, tensor.detach()):
            raise stopped(step + 1, frame, message)
    # Every value is finite but a norm overflows float32: as useless to Adam as a NaN.
    largest = max(gradients, key=lambda name: float(gradients[name].abs().max()))
    raise stopped(step + 1, frame, f"the norm of the gradient of {largest} is beyond float32")


def stopped(step: int, frame: Frame, problem: str) -> UserError:
    """What is said when the parameters have left what can be computed with; `step` counts from 1."""
    return UserError(
        f"training stopped at step {step}, frame {frame.name}: {problem}; what was saved before is untouched. Train "
        "again into another --out with lower trainer.learning_rates, or without that frame"
    )
