"""What `avatar train --refine` began with, and how many steps its time allows."""

from __future__ import annotations

import json
import time
from bisect import bisect_right
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from avatar.compute.device import CPU
from avatar.config import load_config
from avatar.data.json_values import parse_object
from avatar.data.source import Source
from avatar.data.split import check_divided
from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.files.names import ROUNDS_FOLDER
from avatar.files.read import read_json
from avatar.pipeline.choose_device import choose_device
from avatar.pipeline.train import new_avatar
from avatar.pose_refinement.refine_subject import estimated_seconds
from avatar.train.cost_estimate import measure_cost
from avatar.train.frame_order import within_epochs
from avatar.train.loss import choose_perceptual
from data_prep.prepare.open_subject import open_subject

PLAN_FORMAT = 2
LEAST_STEPS = 500  # fewer make no avatar
# A round trains for a few passes over the training frames: with more, the avatar overfits the errors of each frame's
# tracking. Steps are as many passes as this, and no larger share of the run's own; but no fewer than these, where the run
# takes as many: an avatar that is still blurred refines badly, however many passes a few frames get.
FIRST_PASSES, FIRST_SHARE, FIRST_STEPS = 5, 0.25, 1000
PLANNED_SHARE = 0.97  # of the minutes: the rest is for opening and closing the run itself, which nothing before shows


@dataclass(frozen=True)
class Plan:
    rounds: int
    source: Source
    overrides: tuple[str, ...]  # as they were asked for
    minutes: float | None  # that all of it may take
    iterations: int  # of the run itself
    round_iterations: int  # of each of the avatars that are only refined through
    spent: float = 0.0  # seconds of the minutes when the plan was written

    def save(self, run: Path) -> None:
        content = {"format": PLAN_FORMAT, **self.__dict__, "source": self.source.to_dict()}
        write_atomically(plan_file(run), json.dumps(content, indent=1, allow_nan=False).encode())

    @classmethod
    def load(cls, run: Path) -> Plan:
        """Raises UserError for a file that `save` did not write."""
        path = plan_file(run)
        raw = read_json(path)
        if not isinstance(raw, dict) or raw.get("format") != PLAN_FORMAT:
            raise UserError(f"{path} was written by another version of this program; start a new run")
        try:
            plan = parse_object(raw, cls)
            if min(plan.rounds, plan.iterations, plan.round_iterations) < 1:
                raise ValueError("rounds and steps are 1 or more")
        except ValueError as error:
            raise UserError(f"{path} is damaged: {error}; start a new run") from None
        return plan

    def replanned(self, step: float, refinement: float, rounds: int, frames: int) -> Plan:
        """With as many steps as the rest of the minutes allows, by the seconds that a step and a refinement took in a round
        on so many training frames, where so many rounds are still to come; never fewer than make an avatar."""
        assert self.minutes is not None
        asked = within_epochs(load_config(self.overrides).trainer, frames).iterations
        able = affordable_iterations(plannable(self.minutes) - self.spent, step, refinement, rounds, frames)
        chosen = min(asked, max(able, LEAST_STEPS))
        print(
            f"Time         {self.spent:.0f} s of {self.minutes:g} minutes are gone, and a step takes {step:.3f} s: "
            f"{chosen:,} steps are taken" + (", which is more than there is time for" if chosen > able else "")
        )
        return replace(self, iterations=chosen, round_iterations=round_steps(chosen, frames))

    def final_overrides(self) -> list[str]:
        """Of the run itself."""
        asked = load_config(self.overrides).trainer.iterations
        limit = [] if self.iterations == asked else [f"trainer.iterations={self.iterations}"]
        return [*self.overrides, *limit]

    def round_overrides(self) -> list[str]:
        """Of the avatars that are only refined through."""
        return [*self.overrides, f"trainer.iterations={self.round_iterations}"]


def plan_file(run: Path) -> Path:
    return run / ROUNDS_FOLDER / "plan.json"


def round_steps(iterations: int, frames: int) -> int:
    """Of an avatar that is only refined through, before a run of so many iterations on so many training frames."""
    usual = min(round(FIRST_SHARE * iterations), FIRST_PASSES * frames)
    return max(1, min(iterations, max(FIRST_STEPS, usual)))


def plannable(minutes: float) -> float:
    """Seconds that are divided among steps and refinements."""
    return PLANNED_SHARE * 60.0 * minutes


def affordable_iterations(seconds: float, step: float, refinement: float, rounds: int, frames: int) -> int:
    """Steps of the run itself where each takes `step` seconds and each of the rounds ends with a `refinement`; 0 or less
    where there is no time."""
    steps = int((seconds - rounds * refinement) / step)
    if steps <= 0:
        return steps
    return bisect_right(range(steps + 1), steps, key=lambda own: own + rounds * round_steps(own, frames)) - 1


def steps_in_time(
    source: Source, overrides: list[str], rounds: int, minutes: float | None, begin: float
) -> tuple[int, int]:
    """Steps of the run itself and of each round: the configuration's, or as many as the minutes allow that began at
    `begin`, of `time.monotonic`, by what this CPU shows on a few; these count, as preparing the subject does.

    Raises UserError where they allow too few.
    """
    config = load_config(overrides)
    subject, assets = open_subject(source, config.data.test_frames, test_cameras=config.data.test_cameras)
    check_divided(subject.split)
    frames = len(subject.split.train)
    asked = within_epochs(config.trainer, frames).iterations
    # What a GPU takes, the first round shows.
    if minutes is None or choose_device(config.device, lambda _: None) != CPU:
        return asked, round_steps(asked, frames)
    term = choose_perceptual(config.trainer, lambda _: None, size=subject.recording.smallest_size(config.data.size))
    avatar = new_avatar(assets, subject, config, term.name, CPU)
    refinement = estimated_seconds(avatar, subject, config.data.size, torch.tensor(config.data.background))
    frame = subject.frame(subject.split.train[0], config.data.size)
    cost = measure_cost(frame, subject, assets, config)
    step, starts = cost.step_seconds, cost.start_seconds * (1 + rounds)
    spent = time.monotonic() - begin
    able = affordable_iterations(plannable(minutes) - spent - starts, step, refinement, rounds, frames)
    fewest = min(LEAST_STEPS, asked)
    if able < fewest:
        least = spent + starts + rounds * refinement + step * (fewest + rounds * round_steps(fewest, frames))
        raise UserError(
            f"--minutes {minutes:g} is too little for --refine {rounds} of {len(subject)} frames on this machine: "
            f"{spent:.0f} s are gone, it takes about {refinement:.0f} s to refine them and {step:.3f} s a step, so give at "
            f"least {least / plannable(1.0):.1f}"
        )
    chosen = min(asked, able)
    print(
        f"Time         {minutes:g} minutes, {spent:.0f} s of them gone: about {refinement:.0f} s a refinement and "
        f"{step:.3f} s a step allow {able:,} steps; {chosen:,} are taken"
    )
    return chosen, round_steps(chosen, frames)
