"""Quality of held-out frames against training time, for finished or interrupted runs: `avatar bench quality RUN RUN...`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from avatar.bench.clock import Time, paired_medians
from avatar.bench.train import Learner, make_learner, per_step, run_steps, steps_at_once
from avatar.data.loader import FrameLoader
from avatar.errors import UserError
from avatar.evaluation.lpips_networks import find_lpips
from avatar.evaluation.measure import lpips_in_mask, to_8_bit
from avatar.losses.lpips_network import Lpips
from avatar.losses.metrics import psnr, ssim
from avatar.pipeline.open import open_run
from avatar.render import Renderer
from avatar.runs.checkpoint import list_checkpoints, load_checkpoint, load_module
from avatar.runs.run import Run
from avatar.train.objective import perceptual_start
from avatar.types import Frame


@dataclass(frozen=True)
class Point:
    """A checkpoint: held-out frames over the head mask alone, means over frames of 8-bit pictures."""

    step: int
    minutes: float  # of training up to there
    psnr: float  # dB
    ssim: float


@dataclass(frozen=True)
class Curve:
    """One run. Times are those that steps of its configuration take now, in turns with the other runs' steps."""

    run: str
    gaussians: int
    iterations: int  # that its schedule is made for
    early: Time  # milliseconds of a step before the perceptual term takes part
    late: Time  # and after
    frames: int  # held out, evenly spread over the test split
    points: list[Point]
    lpips: float | None = None  # of the last point; None where there are no weights

    @property
    def last(self) -> Point:
        return self.points[-1]

    @property
    def best(self) -> Point:
        return max(self.points, key=lambda point: point.psnr)

    def minutes_to(self, psnr: float) -> float | None:
        """Training time of the first checkpoint that has so many dB; None when none has."""
        return next((point.minutes for point in self.points if point.psnr >= psnr), None)


def measure(
    paths: Sequence[Path], head: Path | None, *, frames: int, repeats: int, say: Callable[[str], None] = print
) -> list[Curve]:
    """A curve for each run. Raises UserError for runs of different subjects: their figures cannot be compared."""
    runs = [open_run(path, head, say=say) for path in paths]
    for run in runs:
        if run.subject.data_hash != runs[0].subject.data_hash:
            raise UserError(f"{run.path} was trained on other data than {runs[0].path}; compare runs of one subject")
    learners = [make_learner(run.avatar, run.subject, run.config, say, run.trained.perceptual) for run in runs]
    times = time_steps(learners, repeats)
    network, note = find_lpips("vgg")
    say(f"LPIPS: {note}")
    curves = []
    for run, learner, (early, late) in zip(runs, learners, times, strict=True):
        points = []
        files = list_checkpoints(run.path / "checkpoints")
        held_out = held_out_frames(run, frames)
        for file in tqdm(files, desc=run.path.name, unit="checkpoint", disable=None):
            checkpoint = load_checkpoint(file)
            load_module(run.avatar, checkpoint.tensors, run.path)
            minutes = minutes_of(learner, checkpoint.step, early, late)
            points.append(Point(checkpoint.step, minutes, *figures(run, held_out)))
        iterations = run.config.trainer.iterations
        lpips = None if network is None else mean_lpips(run, held_out, network)
        curves.append(Curve(str(run.path), len(run.avatar), iterations, early, late, len(held_out), points, lpips))
    return curves


def time_steps(learners: Sequence[Learner], repeats: int) -> list[tuple[Time, Time]]:
    """Milliseconds of an early and a late step of each, taken in turns."""
    steps: dict[tuple[int, bool], Callable[[], object]] = {}
    for index, learner in enumerate(learners):
        for late in (False, True):
            steps[index, late] = lambda learner=learner, late=late: run_steps(learner, late)
    times = paired_medians(steps, repeats, warm_up=2)
    return [
        (times[index, False], per_step(times[index, True], steps_at_once(learner)))
        for index, learner in enumerate(learners)
    ]


def minutes_of(learner: Learner, step: int, early: Time, late: Time) -> float:
    trainer = learner.config.trainer
    before = min(step, perceptual_start(trainer))
    return (before * early.median + (step - before) * late.median) / 60_000


def held_out_frames(run: Run, count: int) -> list[Frame]:
    """As the tracker left them, where the tracking was refined: that was fitted to the frames' own pictures."""
    subject = run.subject.as_tracked()
    test = subject.split.test
    chosen = [test[i] for i in np.unique(np.linspace(0, len(test) - 1, count).round().astype(int))]
    with FrameLoader(subject, run.config.data.size) as loader:
        return list(loader.frames(chosen))


@torch.no_grad()
def pictures(run: Run, frames: Sequence[Frame]) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Render and truth [H, W, 3] of 8 bits each, as values, and the head mask [H, W], for every frame."""
    background = torch.tensor(run.config.data.background)
    renderings = Renderer(run.avatar, background).stream((frame.params, frame.camera) for frame in frames)
    for frame, rendering in zip(frames, renderings, strict=True):
        render, truth = (to_8_bit(p).double() / 255 for p in (rendering.image, frame.composite(background)))
        yield render, truth, frame.head_mask.double()


def figures(run: Run, frames: Sequence[Frame]) -> tuple[float, float]:
    """PSNR and SSIM over the head mask, means over the frames."""
    values = [(float(psnr(*shown)), float(ssim(*shown))) for shown in pictures(run, frames)]
    mean_psnr, mean_ssim = np.mean(values, axis=0).tolist()
    return mean_psnr, mean_ssim


@torch.no_grad()
def mean_lpips(run: Run, frames: Sequence[Frame], network: Lpips) -> float:
    """LPIPS of the head, mean over the frames."""
    shown = pictures(run, frames)
    return float(np.mean([lpips_in_mask(network, (render, truth), mask) for render, truth, mask in shown]))


def pareto(curves: Sequence[Curve]) -> list[Curve]:
    """The runs whose last checkpoint no other run reaches in less time, quickest first."""
    ordered = sorted(curves, key=lambda curve: curve.last.minutes)
    best = [-np.inf, *np.maximum.accumulate([curve.last.psnr for curve in ordered])]
    return [curve for curve, (before, after) in zip(ordered, pairwise(best), strict=True) if after > before]
