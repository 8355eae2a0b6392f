"""Gaussians beside the head in the training background's own colour: no loss sees them, every other background does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.config import TrainerConfig
from avatar.data.loader import FrameLoader
from avatar.data.split import evenly_spread
from avatar.gaussians.base_model import Avatar
from avatar.splat import CannotDraw, checked_drawings
from avatar.splat.sh import C0
from avatar.train.step import stopped
from avatar.types import Frame

WHEN = 0.8  # share of the steps: in those after it other Gaussians take over what the hidden ones covered
FRAMES = 24
LEAST_COVERAGE = 0.01  # pixels, mean over the frames: what covers less is not seen over any background
HIDDEN = -10.0  # logit of an opacity below which no splat is drawn


def prune_step(config: TrainerConfig) -> int | None:
    """After how many steps background Gaussians are pruned; None: never."""
    return round(WHEN * config.iterations) if config.prune_share > 0 else None


def prune_background_gaussians(
    avatar: Avatar, loader: FrameLoader, train: Sequence[int], share: float, step: int
) -> int:
    """Hide each Gaussian of whose cover in some of the frames `train` less than `share` lies on the head; returns how many.

    They keep their place in every tensor, with an opacity that is never drawn. A function of the parameters and the
    frames. Raises UserError, naming `step` and the frame, when the Gaussians cannot be drawn.
    """
    chosen = evenly_spread(train, FRAMES)
    total = sum((coverage(avatar, frame, step) for frame in loader.frames(chosen)), start=torch.zeros(()))
    both = total.sum(dim=1)
    pruned = (both > LEAST_COVERAGE * len(chosen)) & (total[:, 0] < share * both)
    with torch.no_grad():
        avatar.opacity_logits[: len(pruned)][pruned] = HIDDEN
    return int(pruned.sum())


def coverage(avatar: Avatar, frame: Frame, step: int) -> Float[Tensor, "N 2"]:
    """Pixels of the frame that each Gaussian covers, by its weight in their colour: of the head and of what is around it.

    A pixel's colour is a sum of the Gaussians' colours by their weights, so that the gradient in the colours is the cover.
    """
    with torch.no_grad():
        gaussians = avatar(frame.params, None, frame.camera.head_rotation)
    flat = gaussians.means.new_zeros(len(gaussians.means), 1, 3).requires_grad_()
    black = flat.new_zeros(3)
    try:
        with checked_drawings():
            drawn = avatar.draw(gaussians._replace(sh=flat), frame.camera, black)
    except CannotDraw as error:
        raise stopped(step, frame, str(error)) from error
    head = frame.alpha * frame.head_mask
    by_channel = torch.stack((head, 1.0 - head, torch.zeros_like(head)), dim=-1)
    (gradient,) = torch.autograd.grad(drawn.image, flat, by_channel / C0)
    return gradient[:, 0, :2]
