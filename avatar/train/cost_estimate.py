"""What training on this folder will take, measured on a few steps of the real thing."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
import torch

from avatar.config import Config, TrainerConfig
from avatar.data.frame import Frame
from avatar.data.subject import Subject
from avatar.head.assets import HeadAssets
from avatar.runs.model_registry import make_avatar
from avatar.train.loss import TrainingLoss, choose_perceptual, perceptual_start
from avatar.train.optimizer import make_optimizer
from avatar.train.pose_corrections import make_pose_corrections
from avatar.train.step import TrainState
from avatar.train.step_runner import StepRunner
from avatar.train.trainer import initialize_from_frames

MEASURED_STEPS = 3  # of each kind, after one that is not counted
LONGEST = 10.0  # seconds of one kind after which no more are made; where the first takes as long, it is counted


@dataclass(frozen=True)
class Cost:
    gaussians: int
    parameters: int
    start_seconds: float  # until the first step
    step_seconds: float  # on this machine, the mean over the run; of each kind of step the median
    iterations: int


def measure_cost(frame: Frame, subject: Subject, assets: HeadAssets, config: Config) -> Cost:
    """Train an avatar of the subject on one of its frames for a few steps, and throw it away.

    It starts as in training: what a step takes depends on where the Gaussians are. Raises UserError as training does before
    its first step, and for frames that are too small to train on.
    """
    torch.manual_seed(config.trainer.seed)
    begin = time.perf_counter()
    avatar = make_avatar(assets, subject.identity, config.model)
    initialize_from_frames(avatar, subject, config)
    start_seconds = time.perf_counter() - begin
    corrections = make_pose_corrections(avatar, [frame.time], config.trainer)
    optimizer = make_optimizer(avatar, config.trainer, corrections)
    size = subject.recording.smallest_size(config.data.size)
    term = choose_perceptual(config.trainer, lambda _: None, size=size)
    objective = TrainingLoss(config.trainer, torch.tensor(config.data.background), term)
    steps = StepRunner(TrainState(avatar, optimizer, objective, corrections))

    def seconds(step: int) -> float:
        taken: list[float] = []
        while len(taken) <= MEASURED_STEPS and sum(taken) < LONGEST:
            begin = time.perf_counter()
            steps.make(step, frame, None)
            taken.append(time.perf_counter() - begin)
        return float(np.median(taken[1:] or taken))

    kinds = kinds_of_steps(config.trainer, term.every)
    total = sum(count * seconds(step) for count, step in kinds)
    return Cost(
        gaussians=len(avatar),
        parameters=sum(p.numel() for p in avatar.parameters()),
        start_seconds=start_seconds,
        step_seconds=total / config.trainer.iterations,
        iterations=config.trainer.iterations,
    )


def kinds_of_steps(trainer: TrainerConfig, every: int) -> list[tuple[int, int]]:
    """How many steps of a run are alike in what their loss takes, and the last one of them: before the perceptual term,
    with it, which every so many-th step is, and between those."""
    start = perceptual_start(trainer)
    late = trainer.iterations - start
    with_term = math.ceil(late / every)
    last_with_term = start + (with_term - 1) * every
    last = trainer.iterations - 1
    kinds = [
        (start, start - 1),
        (with_term, last_with_term),
        (late - with_term, last if last != last_with_term else last - 1),
    ]
    return [(count, step) for count, step in kinds if count]
