"""What a training step minimises: the photometric terms, and LPIPS or D-SSIM from a step on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, l1_loss

from avatar.compute.device import CPU
from avatar.config import TrainerConfig
from avatar.data.frame import Frame
from avatar.errors import UserError
from avatar.gaussians.uv_base_model import SH_DEGREE
from avatar.losses.lpips import MissingWeights, load_lpips
from avatar.losses.lpips_network import MIN_SIZE, Net
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

SH_INTERVAL = 500  # steps after which one more spherical-harmonics degree takes part
PERCEPTUAL_START = 0.5  # share of the steps after which the perceptual term takes part (15,000 of 30,000)
SPARSE_EVERY = 10  # LPIPS takes part in every so many-th step, with so many times the weight, where it is sparse


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


def sh_degree(step: int) -> int:
    """The degree of the view-dependent colour that takes part in step `step` (from 0)."""
    return min(step // SH_INTERVAL, SH_DEGREE)


def perceptual_start(config: TrainerConfig) -> int:
    """The first step (from 0) in which the perceptual term takes part."""
    return round(PERCEPTUAL_START * config.iterations)


@dataclass(frozen=True)
class TrainingLoss:
    """What a step minimises, for any frame."""

    config: TrainerConfig
    background: Float[Tensor, " 3"]
    perceptual: PerceptualTerm

    def background_of(self, step: int) -> Float[Tensor, " 3"]:
        """Behind the head in step `step` (from 0): over one colour alone, Gaussians of that colour cost nothing."""
        every = self.config.opposite_background_every
        return self._opposite if every is not None and step % every == every - 1 else self.background

    @cached_property
    def _opposite(self) -> Float[Tensor, " 3"]:
        return opposite_background(self.background)

    def term(self, step: int) -> Weighted | None:
        """The third term of step `step`."""
        return self.perceptual.at(step, perceptual_start(self.config))

    def loss(
        self,
        step: int,
        frame: Frame,
        image: Float[Tensor, "H W 3"],
        target: Tensor,
        crop: tuple[Tensor, Tensor] | None = None,
        smaller: Sequence[Float[Tensor, "_ _ 3"]] = (),
    ) -> PhotometricLoss:
        """`crop`, rows and columns, takes the place of the frame's box of the head. Each of the `smaller` images adds
        its L1 distance to the target at its size. Pixels that the frame's picture does not hold cost nothing."""
        term = self.term(step)
        function = term and term.function
        if term and term.crops:
            function = partial(term.function, box=frame.head_box, crop=crop)
        loss = photometric_loss(
            where_seen(image, target, frame),
            target,
            frame.mouth_mask,
            frame.head_mask,
            perceptual=function,
            perceptual_weight=term.weight if term else 0.0,
        )
        for other in smaller:
            wanted = at_size(target, other)
            distance = l1_loss(where_seen(other, wanted, frame), wanted)
            loss = loss._replace(total=loss.total + distance, frame=loss.frame + distance)
        return loss


def opposite_background(background: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """Each channel 0 or 1, whichever is farther away."""
    return (background < 0.5).to(background)


def at_size(image: Float[Tensor, "H W C"], other: Float[Tensor, "h w _"]) -> Float[Tensor, "h w C"]:
    """`image` at the size of `other`, which is a whole number of times smaller and may reach beyond it at the right and the
    bottom: means over the area of each pixel, as far as the image has it."""
    factor = -(-max(image.shape[:2]) // max(other.shape[:2]))
    small = avg_pool2d(image.permute(2, 0, 1)[None], factor, ceil_mode=True, count_include_pad=False)
    return small[0].permute(1, 2, 0)


def where_seen(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], frame: Frame) -> Float[Tensor, "h w 3"]:
    """`image`, and `target` where the frame's picture holds no whole pixel of that size."""
    if frame.seen is None:
        return image
    return torch.where(at_size(frame.seen[..., None].float(), image) == 1, image, target)


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
    is_auto = config.perceptual == "auto"
    lpips_name = "lpips-squeeze" if is_auto else config.perceptual
    if lpips_name.startswith("lpips-") and recorded in (None, lpips_name):
        try:
            if size is not None and min(size) < MIN_SIZE:
                raise UserError(too_small("LPIPS", MIN_SIZE, size))
            lpips = load_lpips(cast(Net, lpips_name.removeprefix("lpips-")), download=not is_auto).on(device)
            crops = config.sparse_lpips
            function = on_head(masked_lpips(lpips)) if crops else masked_lpips(lpips)
            every = SPARSE_EVERY if config.sparse_lpips else 1
            return PerceptualTerm(lpips_name, Weighted(function, LPIPS_WEIGHT, crops), every, in_its_place, before)
        except UserError as error:
            if recorded is not None:
                raise UserError(f"the run began with LPIPS and cannot go on without it: {error}") from None
            if not is_auto:
                raise UserError(
                    f"{error}. This configuration trains with LPIPS (trainer.perceptual={lpips_name}); "
                    "trainer.perceptual=dssim trains without, and its figures do not compare"
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
