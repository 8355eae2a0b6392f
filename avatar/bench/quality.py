"""Quality of held-out frames against training time, for finished or interrupted runs: `avatar bench quality RUN RUN...`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from tqdm import tqdm

from avatar.bench import Request
from avatar.bench.clock import Time
from avatar.bench.figures import head_figures
from avatar.bench.results import Line, Panel, write_report
from avatar.bench.train import Learner, make_learner, time_steps
from avatar.data.frame import Frame
from avatar.data.loader import FrameLoader
from avatar.data.split import evenly_spread
from avatar.errors import UserError
from avatar.evaluation.find_lpips import find_lpips
from avatar.pipeline.open_inputs import open_run
from avatar.runs.checkpoint import list_checkpoints, load_checkpoint, load_module
from avatar.runs.run import Run
from avatar.train.loss import perceptual_start

FRAMES, FULL_FRAMES, QUICK_FRAMES = 50, 10_000, 2
REPEATS, QUICK_REPEATS = 11, 1
NEAR = 0.3  # dB below a run's own last figure


@dataclass(frozen=True)
class Point:
    """A checkpoint: held-out frames over the head mask alone, means over frames of 8-bit pictures."""

    step: int
    minutes: float  # of training up to there
    psnr: float  # dB
    ssim: float
    lpips: float  # of the last checkpoint where there are weights, else NaN


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

    @property
    def last(self) -> Point:
        return self.points[-1]

    @property
    def best(self) -> Point:
        return max(self.points, key=lambda point: point.psnr)

    def minutes_to(self, psnr: float) -> float | None:
        """Training time of the first checkpoint that has so many dB; None when none has."""
        return next((point.minutes for point in self.points if point.psnr >= psnr), None)


def run(request: Request) -> None:
    """Measure, print and write. The first run is the yardstick. `full` takes every held-out frame."""
    frames = QUICK_FRAMES if request.quick else FULL_FRAMES if request.full else FRAMES
    repeats = QUICK_REPEATS if request.quick else REPEATS
    curves = measure(request.inputs, request.head, frames=frames, repeats=repeats)
    content = {"curves": [asdict(curve) for curve in curves]}
    write_report(request.out, "bench_quality", table(curves), content, panels(curves))


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
        held_out = [(frame.params, frame.camera, frame) for frame in held_out_frames(run, frames)]
        for file in tqdm(files, desc=run.path.name, unit="checkpoint", disable=None):
            checkpoint = load_checkpoint(file)
            load_module(run.avatar, checkpoint.tensors, run.path)
            minutes = minutes_of(learner, checkpoint.step, early, late)
            # LPIPS takes long: of the last checkpoint alone.
            found = head_figures(run.avatar, run.trained.background, held_out, network if file == files[-1] else None)
            points.append(Point(checkpoint.step, minutes, found.psnr, found.ssim, found.lpips))
        iterations = run.config.trainer.iterations
        curves.append(Curve(str(run.path), len(run.avatar), iterations, early, late, len(held_out), points))
    return curves


def minutes_of(learner: Learner, step: int, early: Time, late: Time) -> float:
    trainer = learner.config.trainer
    before = min(step, perceptual_start(trainer))
    return (before * early.median + (step - before) * late.median) / 60_000


def held_out_frames(run: Run, count: int) -> list[Frame]:
    """As the tracker left them, where the tracking was refined: that was fitted to the frames' own pictures."""
    subject = run.subject.as_tracked()
    with FrameLoader(subject, run.config.data.size) as loader:
        return list(loader.frames(evenly_spread(subject.split.test, count)))


def pareto(curves: Sequence[Curve]) -> list[Curve]:
    """The runs whose last checkpoint no other run reaches in less time, quickest first."""
    ordered = sorted(curves, key=lambda curve: curve.last.minutes)
    best = [-np.inf, *np.maximum.accumulate([curve.last.psnr for curve in ordered])]
    return [curve for curve, (before, after) in zip(ordered, pairwise(best), strict=True) if after > before]


def table(curves: Sequence[Curve]) -> list[str]:
    """The last and the best checkpoint of each run, and how soon each has what the first run ends with."""
    yardstick, front = curves[0], pareto(curves)
    goals = [f"to {point.psnr:.2f} dB" for point in (yardstick.last, yardstick.best)]
    lines = [
        f"{'run':>16} {'steps':>6} {'ms/step':>15} {'minutes':>8} {'PSNR':>6} {'SSIM':>7} {'LPIPS':>6} {'best PSNR':>16} "
        f"{goals[0]:>11} {goals[1]:>11} {f'within {NEAR} dB':>13}"
    ]
    for curve in curves:
        last, best = curve.last, curve.best
        lpips = "-" if math.isnan(last.lpips) else f"{last.lpips:.4f}"
        finest = f"{best.psnr:.2f} ({best.minutes:.2f})"
        lines.append(
            f"{Path(curve.run).name:>16} {last.step:6} {f'{curve.early.median:.1f}, {curve.late.median:.1f}':>15} "
            f"{last.minutes:8.2f} {last.psnr:6.2f} {last.ssim:7.4f} {lpips:>6} {finest:>16} "
            f"{minutes(curve.minutes_to(yardstick.last.psnr)):>11} {minutes(curve.minutes_to(yardstick.best.psnr)):>11} "
            f"{minutes(curve.minutes_to(last.psnr - NEAR)):>13}"
        )
    lines += [
        "",
        f"{curves[0].frames} held-out frames, head mask alone, driven by the tracker's tracking. ms/step: before and after "
        "the perceptual term takes part.",
        f"Minutes of training at that rate, at the checkpoints that were kept: to the last and to the best PSNR of "
        f"{Path(yardstick.run).name}, and within {NEAR} dB of the run's own last.",
        f"No other run is as good in less time: {', '.join(Path(curve.run).name for curve in front)}",
    ]
    return lines


def minutes(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def panels(curves: Sequence[Curve]) -> list[Panel]:
    """PSNR and SSIM against training time; the last checkpoints that are best for their time are joined."""
    found = []
    for name, unit in (("psnr", "PSNR, dB"), ("ssim", "SSIM")):
        lines = [
            Line(Path(curve.run).name, [p.minutes for p in curve.points], [getattr(p, name) for p in curve.points])
            for curve in curves
        ]
        best = [curve.last for curve in pareto(curves)]
        lines.append(Line("best for their time", [p.minutes for p in best], [getattr(p, name) for p in best], "ks:"))
        found.append(Panel("minutes of training", f"{unit}, held-out frames, head mask", lines, log_y=False))
    return found
