"""The paper's figure of convergence (supplement): FlashAvatar and HyperGaussians after 5, 20, 60, 180 and 600 seconds.

    python scripts/paper/convergence.py FOLDER --out runs/paper [--head HEAD] [--seconds 5 20 60] [key=value ...]

The clock runs during training steps alone, decoding included, and stands still while held-out frames are measured and the
state is saved. Systems take turns at every mark, so that a busy machine meets them alike. A stopped run goes on from its
last mark; marks may be added later, beyond the last. Figures are of the head alone, means over held-out frames.
Leaves convergence.md, convergence.csv and convergence.png in --out, and the state in --out/convergence.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from systems import add_source_arguments, folders_and_overrides, systems
from torch import Tensor
from write_report import machine, run, table, write_report

from avatar.bench.results import new_figure
from avatar.config import Config, load_config
from avatar.data.frame import Frame
from avatar.data.loader import FrameLoader
from avatar.data.source import Source
from avatar.data.split import evenly_spread
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.head.assets import HeadAssets
from avatar.losses.metrics import psnr, ssim
from avatar.render import Renderer
from avatar.runs.checkpoint import (
    Checkpoint,
    list_checkpoints,
    load_checkpoint,
    load_module,
    module_tensors,
    save_checkpoint,
)
from avatar.runs.model_registry import make_avatar
from avatar.tensors import to_8_bit
from avatar.train.frame_order import frame_order
from avatar.train.loss import TrainingLoss, choose_perceptual
from avatar.train.optimizer import load_optimizer, make_optimizer, optimizer_tensors
from avatar.train.step import TrainState
from avatar.train.step_runner import StepRunner
from data_prep.prepare.open_subject import find_head, open_subject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SYSTEMS = ("FlashAvatar", "HyperGaussians n=8")
SECONDS = (5.0, 20.0, 60.0, 180.0, 600.0)  # of the paper's pictures
BETWEEN = 2  # marks of the curve between two pictures


class Learner:
    """One system in training, with what its clock and its measurements say."""

    def __init__(self, name: str, folder: Path, subject: Subject, assets: HeadAssets, config: Config) -> None:
        self.name, self.folder, self.subject, self.config = name, folder, subject, config
        torch.manual_seed(config.trainer.seed)
        self.avatar = make_avatar(assets, subject.identity, config.model)
        self.optimizer = make_optimizer(self.avatar, config.trainer)
        self.background = torch.tensor(config.data.background)
        term = choose_perceptual(config.trainer, print, size=subject.image_size(config.data.size))
        self.objective = TrainingLoss(config.trainer, self.background, term)
        self.steps = StepRunner(TrainState(self.avatar, self.optimizer, self.objective))
        self.step, self.points = 0, [{"mark": 0.0, "seconds": 0.0, "step": 0}]
        recorded = {"data_hash": subject.data_hash, "config": config.to_dict(), "perceptual": term.name}
        self.recorded = json.loads(json.dumps(recorded))  # as a checkpoint gives it back
        if files := list_checkpoints(folder):
            self._go_on(load_checkpoint(files[-1]))

    def _go_on(self, checkpoint: Checkpoint) -> None:
        if {key: checkpoint.meta.get(key) for key in self.recorded} != self.recorded:
            raise UserError(
                f"{self.folder} holds a training of other data or another configuration; give another --out"
            )
        load_module(self.avatar, checkpoint.tensors, self.folder)
        load_optimizer(self.optimizer, dict(self.avatar.named_parameters()), checkpoint.tensors)
        self.step, self.points = checkpoint.step, list(checkpoint.meta["points"])

    def train_until(self, mark: float, loader: FrameLoader) -> None:
        """Steps until the clock shows `mark` seconds, or all steps are made."""
        trainer, before = self.config.trainer, self.points[-1]["seconds"]
        begin = time.perf_counter()
        for frame in loader.frames(frame_order(self.subject.split.train, trainer.seed, self.step, trainer.iterations)):
            self.steps.make(self.step, frame, None)
            self.step += 1
            if before + time.perf_counter() - begin >= mark:
                break
        self.points.append({"mark": mark, "seconds": before + time.perf_counter() - begin, "step": self.step})

    def measure(self, frames: Sequence[Frame]) -> None:
        """Add the figures to the newest mark, leave its picture of the middle frame, and save everything."""
        values = []
        for frame in frames:
            shown, truth = self.draw(frame), frame.composite(self.background)
            pair = [to_8_bit(image).double() / 255 for image in (shown, truth)]
            values.append((float(psnr(*pair, frame.head_mask)), float(ssim(*pair, frame.head_mask))))
        self.points[-1] |= dict(zip(("psnr", "ssim"), np.mean(values, axis=0).tolist(), strict=True))
        write_atomically(self.picture(self.points[-1]["mark"]), as_png(self.draw(frames[len(frames) // 2])))
        tensors = {
            **module_tensors(self.avatar),
            **optimizer_tensors(self.optimizer, dict(self.avatar.named_parameters())),
        }
        save_checkpoint(self.folder, Checkpoint(self.step, tensors, {**self.recorded, "points": self.points}), keep=1)

    @torch.no_grad()
    def draw(self, frame: Frame) -> Tensor:
        return Renderer(self.avatar, self.background).render(frame.params, frame.camera).image

    def picture(self, mark: float) -> Path:
        return self.folder / f"{mark:g}.png"


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_source_arguments(parser)
    parser.add_argument("--seconds", type=float, nargs="+", default=SECONDS, help="marks with a picture")
    parser.add_argument("--systems", nargs="+", default=SYSTEMS, metavar="NAME", help="of any of the tables")
    parser.add_argument("--frames", type=int, default=20, help="held-out frames that are measured")
    given = parser.parse_intermixed_args(words)
    folders, overrides = folders_and_overrides(given.arguments)
    if len(folders) != 1 or min(given.seconds) <= 0:
        parser.error("give one tracked folder, and seconds above 0")
    rows = {row["name"]: [*row["overrides"], *overrides] for row in systems(given.systems)}
    source = Source(folders[0], find_head(folders[0], given.head), frame_offset=given.frame_offset)
    configs = {name: load_config(words) for name, words in rows.items()}
    if any(config.trainer.pose_rate or config.trainer.condition_noise for config in configs.values()):
        parser.error("systems are trained without pose corrections and noise, as published: leave both keys at 0")
    subject, assets = open_subject(source, next(iter(configs.values())).data.test_frames)
    place = given.out / "convergence" / subject.name
    learners = [Learner(n, place / re.sub(r"\W+", "_", n), subject, assets, c) for n, c in configs.items()]
    frames = held_out(subject, learners[0].config, given.frames)
    take_turns(learners, marks(given.seconds), frames)
    truth = frames[len(frames) // 2].composite(learners[0].background)
    report(given.out, subject.name, learners, given.seconds, (truth * 255).round().byte().numpy(), len(frames))
    return 0


def marks(seconds: Sequence[float], between: int = BETWEEN) -> list[float]:
    """The marks with a picture and, on a logarithmic scale, `between` others before each but the first."""
    shown = sorted(set(seconds))
    found = [shown[0]]
    for low, high in itertools.pairwise(shown):
        found += [*np.geomspace(low, high, between + 2)[1:-1].round(1).tolist(), high]
    return sorted(set(found))


def held_out(subject: Subject, config: Config, count: int) -> list[Frame]:
    """As the tracker left them, where the tracking was refined."""
    with FrameLoader(subject.as_tracked(), config.data.size) as loader:
        return list(loader.frames(evenly_spread(subject.split.test, count)))


def take_turns(learners: Sequence[Learner], at: Sequence[float], frames: Sequence[Frame]) -> None:
    loaders = [FrameLoader(x.subject, x.config.data.size) for x in learners]
    try:
        for mark in at:
            for learner, loader in zip(learners, loaders, strict=True):
                if learner.points[-1]["mark"] < mark and learner.step < learner.config.trainer.iterations:
                    learner.train_until(mark, loader)
                    learner.measure(frames)
                    point = learner.points[-1]
                    print(f"{mark:6g} s  {learner.name}: step {point['step']}, {point['psnr']:.2f} dB", flush=True)
    finally:
        for loader in loaders:
            loader.__exit__(None, None, None)


def as_png(image: Tensor) -> bytes:
    return cv2.imencode(".png", to_8_bit(image).numpy()[..., ::-1])[1].tobytes()


def report(
    folder: Path, name: str, learners: Sequence[Learner], seconds: Sequence[float], truth: np.ndarray, frames: int
) -> None:
    found: dict[str, dict[float, Mapping[str, Any]]] = {x.name: {p["mark"]: p for p in x.points[1:]} for x in learners}
    reached = sorted(set().union(*found.values()))
    shown = [mark for mark in sorted(set(seconds)) if mark in reached]

    def cell(points: Mapping[float, Mapping[str, Any]], mark: float) -> str:
        point = points.get(mark)
        return "-" if point is None else f"{point['psnr']:.2f}, {point['ssim']:.4f} ({point['step']:,})"

    config = learners[0].config
    page = [
        f"# Convergence over wall time, {name}",
        "",
        "PSNR and SSIM of the head alone (steps).",
        "",
        *table(["seconds", *found], [[f"{m:g}", *(cell(points, m) for points in found.values())] for m in reached]),
        "",
        f"{frames} held-out frames, {truth.shape[1]} pixels wide, {len(learners[0].avatar):,} Gaussians, training made for "
        f"{config.trainer.iterations:,} steps, {learners[0].objective.perceptual.name}. {machine()}",
    ]
    fields = ["mark", "seconds", "step", "psnr", "ssim"]
    rows = [["system", *fields]] + [
        [n, *(p[f] for f in fields)] for n, points in found.items() for p in points.values()
    ]
    write_report(folder, "convergence", page, rows, draw(learners, found, shown, truth))


def draw(
    learners: Sequence[Learner],
    found: Mapping[str, Mapping[float, Mapping[str, Any]]],
    shown: Sequence[float],
    truth: np.ndarray,
) -> Figure:
    """Pictures at the marks, a row for each system; under them the curves."""
    figure = new_figure(2.2 * (len(shown) + 1), 2.4 * len(learners) + 3.5)
    upper, lower = figure.subfigures(2, 1, height_ratios=(2.4 * len(learners), 3.5))
    for learner, row in zip(learners, upper.subplots(len(learners), len(shown) + 1, squeeze=False), strict=True):
        for axes, mark in zip(row, [*shown, None], strict=True):
            axes.set(xticks=[], yticks=[], title="truth" if mark is None else f"{mark:g} s")
            if mark is None:
                axes.imshow(truth)
            elif mark in found[learner.name]:
                axes.imshow(cv2.imread(str(learner.picture(mark)))[..., ::-1])
        row[0].set_ylabel(learner.name, fontsize=8)
    for axes, figure_name in zip(lower.subplots(1, 2), ("psnr", "ssim"), strict=True):
        for name, points in found.items():
            own = [(point["seconds"], point[figure_name]) for point in points.values()]
            axes.plot(*zip(*own, strict=True), "o-", ms=3, label=name)
        axes.set(xscale="log", xlabel="seconds of training", ylabel=f"{figure_name.upper()}, head alone")
        axes.set_xticks(shown, [f"{mark:g}" for mark in shown])
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure


if __name__ == "__main__":
    run(main)
