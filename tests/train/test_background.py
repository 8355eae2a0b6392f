"""What training renders over: one background alone cannot tell a Gaussian of its colour from none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_runs import new_avatar, open_small, small_config
from torch import Tensor

from avatar.splat.sh import C0
from avatar.train.loss import PerceptualTerm, TrainingLoss
from avatar.train.optimizer import make_optimizer
from avatar.train.step import StepInputs, TrainState, gradients_of, train_step
from avatar.train.step_runner import StepRunner

WHITE, BLACK = torch.ones(3), torch.zeros(3)


@pytest.mark.parametrize(
    ("background", "opposite"),
    [(WHITE, WHITE - 1), (BLACK, BLACK + 1), (torch.tensor([0.0, 0.7, 0.5]), torch.tensor([1.0, 0.0, 0.0]))],
)
def test_every_third_step_is_over_the_opposite_background(background: Tensor, opposite: Tensor) -> None:
    every_third = TrainingLoss(small_config().trainer, background, PerceptualTerm("none"))
    found = [every_third.background_of(step) for step in range(6)]
    for colour, expected in zip(found, [background, background, opposite] * 2, strict=True):
        assert torch.equal(colour, expected)
    never = small_config("trainer.opposite_background_every=null").trainer
    assert torch.equal(TrainingLoss(never, background, PerceptualTerm("none")).background_of(2), background)


def test_a_step_makes_white_gaussians_beside_the_head_fade_over_black_alone(tracked_folder: Path) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    objective = TrainingLoss(config.trainer, WHITE, PerceptualTerm("none"))
    frame = subject.frame(subject.split.train[0], config.data.size)
    beside = replace(frame, head_mask=torch.zeros_like(frame.head_mask))

    def step(number: int) -> tuple[Tensor, StepInputs]:
        avatar = new_avatar(assets, subject, config)
        with torch.no_grad():
            avatar.sh_dc.fill_(0.5 / C0)
        state = TrainState(avatar, make_optimizer(avatar, config.trainer), objective)
        inputs = StepRunner(state).inputs(number, beside)
        train_step(state, number, inputs)
        return gradients_of(state)["opacity_logits"], inputs

    over_white, _ = step(0)
    over_black, inputs = step(2)
    assert torch.equal(inputs.tensors()["background"], BLACK)
    assert over_white.abs().max() < 1e-6 < 1e-5 < over_black.max() and over_black.min() >= -1e-6


def test_features_in_place_of_colours_keep_one_background(tracked_folder: Path) -> None:
    """Gaussian Head Avatar on two backgrounds is 0.8 dB worse on the head after 600 steps."""
    config = small_config("model=gaussianheadavatar")
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    objective = TrainingLoss(config.trainer, WHITE, PerceptualTerm("none"))
    steps = StepRunner(TrainState(avatar, make_optimizer(avatar, config.trainer), objective))
    frame = subject.frame(subject.split.train[0], config.data.size)
    assert torch.equal(steps.inputs(2, frame).background, WHITE)
