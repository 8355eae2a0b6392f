"""What refinement gives back of what trackers' errors take: a subject's tracking perturbed, refined and trained on again.

The folder's own tracking stands for the truth, and its last frames, which no training sees, are measured. Four avatars of
the same recipe: trained on the tracking as given, on the perturbed one, and on both as `avatar train --refine 1` refines
them, through an avatar that is only trained for that. Each is driven by the tracking that it was trained on; where that was
refined, it was fitted to the measured frames' pictures too.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from avatar.bench import Request
from avatar.bench.figures import Figures, head_figures
from avatar.bench.perturb_tracking import COEFFICIENT_SHARE, SHIFT_MM, TURN_DEGREES, perturbed
from avatar.bench.results import write_report
from avatar.config import Config, TrainerConfig, load_config
from avatar.data.recording import Recording
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.pipeline.refine_plan import round_steps
from avatar.pose_refinement.refine_subject import refine_subject
from avatar.runs.model_registry import make_avatar
from avatar.train.frame_order import within_epochs
from avatar.train.loss import choose_perceptual
from avatar.train.trainer import train
from data_prep.prepare.open_subject import find_head, open_subject

SEED = 0
MEASURED_EVERY = 2  # held-out frames
GIVEN, DISTURBED, REFINED, GIVEN_REFINED = "as given", "disturbed", "disturbed, refined", "given, refined"
QUICK = ("data.size=64", "model.uv_size=24", "model.mlp_width=24", "trainer.iterations=60")


@dataclass(frozen=True)
class Row:
    """One avatar: the tracking that it was trained on, and how it draws held-out frames."""

    tracking: str
    figures: Figures
    pixels: float  # of the video, from that tracking's vertices to those of the given one


def run(request: Request) -> None:
    (folder,) = request.inputs
    config = load_config([*(QUICK if request.quick else ()), "trainer.checkpoint_every=1000000", *request.overrides])
    source = Source(folder, find_head(folder, request.head), request.tracking, request.frame_offset)
    rows = measure(source, config, request.out)
    content = {
        "folder": folder.resolve().name,
        "config": config.to_dict(),
        "disturbance": {"degrees": TURN_DEGREES, "mm": SHIFT_MM, "coefficients": COEFFICIENT_SHARE, "seed": SEED},
        "recovered": recovered(rows),
        "rows": [asdict(row) for row in rows],
    }
    write_report(request.out, f"bench_refine_{folder.resolve().name}", report(rows, config), content)


def measure(source: Source, config: Config, out: Path) -> list[Row]:
    """Train and refine; what is written on the way lies in a temporary folder."""
    subject, assets = open_subject(source, config.data.test_frames, print)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(dir=out) as scratch:
        trial = Trial(subject, assets, config, Path(scratch))
        bent = perturbed(subject.recording, HeadModel(assets, subject.identity), SEED)
        for name, recording, again in ((GIVEN, subject.recording, GIVEN_REFINED), (DISTURBED, bent, REFINED)):
            rows.append(trial.row(name, recording))
            rows.append(trial.row(again, trial.refined(recording, f"{name}, first")))
    return rows


@dataclass(frozen=True)
class Trial:
    """One subject, whose own recording counts as the truth."""

    subject: Subject
    assets: HeadAssets
    config: Config
    scratch: Path

    def trained(self, recording: Recording, name: str) -> Avatar:
        """An avatar of the subject's pictures with this tracking. Raises KeyboardInterrupt after an interruption."""
        trainer = within_epochs(self.config.trainer, len(recording.split.train))
        config, subject = replace(self.config, trainer=trainer), replace(self.subject, recording=recording)
        torch.manual_seed(config.trainer.seed)
        avatar = make_avatar(self.assets, subject.identity, config.model)
        term = choose_perceptual(config.trainer, print, size=subject.image_size(config.data.size))
        if train(avatar, subject, config, self.scratch / name, term) < config.trainer.iterations:
            raise KeyboardInterrupt
        return avatar.eval()

    def refined(self, recording: Recording, name: str) -> Recording:
        """The tracking refined through a shortly trained avatar. Raises KeyboardInterrupt after an interruption."""
        frames = len(recording.split.train)
        trainer = within_epochs(self.config.trainer, frames)
        steps = round_steps(trainer.iterations, frames)
        short = replace(self.config, trainer=replace(trainer, iterations=steps))
        avatar = replace(self, config=short).trained(recording, name)
        background = torch.tensor(self.config.data.background)
        subject = replace(self.subject, recording=recording)
        found = refine_subject(avatar, subject, self.config.data.size, background, self.scratch / "progress")
        if found is None:
            raise KeyboardInterrupt
        return replace(recording, tracks=found.tracks)

    def row(self, name: str, recording: Recording) -> Row:
        avatar = self.trained(recording, name)
        shown = [(index, index) for index in recording.split.test[::MEASURED_EVERY]]
        figures = driven_figures(avatar, recording, self.subject, shown, self.config)
        return Row(name, figures, vertex_error(avatar.head, recording, self.subject.recording))


def driven_figures(
    avatar: Avatar, recording: Recording, truth: Subject, shown: Sequence[tuple[int, int]], config: Config
) -> Figures:
    """Of the avatar driven by some frames of a recording, against the true subject's pictures.

    `shown` are the frames' indices in the recording and in the true subject.
    """
    size = config.data.size
    driven = [(recording.params(i), recording.camera(i, size), truth.frame(true, size)) for i, true in shown]
    return head_figures(avatar, torch.tensor(config.data.background), driven)


def vertex_error(head: HeadModel, recording: Recording, truth: Recording) -> float:
    """How far vertices are from where the truth has them, in pixels of the video: root mean square over the vertices, mean
    over the held-out frames."""
    distances = []
    for index in recording.split.test:
        ours, theirs = (
            one.camera(index).project(head.vertices(one.params(index)))[:, :2] for one in (recording, truth)
        )
        distances.append(float((ours - theirs).square().sum(dim=1).mean().sqrt()))
    return float(np.mean(distances))


def recovered(rows: Sequence[Row]) -> float:
    """The share of the PSNR lost by the disturbance that refining and training again brought back."""
    by_name = {row.tracking: row.figures.psnr for row in rows}
    return (by_name[REFINED] - by_name[DISTURBED]) / (by_name[GIVEN] - by_name[DISTURBED])


def report(rows: Sequence[Row], config: Config) -> list[str]:
    return [
        f"Held-out frames, head alone, {planned_steps(config.trainer)}, driven by the tracking that was trained on",
        f"{'trained on':>20} {'PSNR':>7} {'SSIM':>7}   vertices, px",
        *(f"{row.tracking:>20} {row.figures.psnr:7.2f} {row.figures.ssim:7.4f} {row.pixels:14.3f}" for row in rows),
        "",
        f"{recovered(rows):.0%} of the PSNR lost by the disturbance came back",
    ]


def planned_steps(config: TrainerConfig) -> str:
    """How many steps that is, for a heading, before the number of frames is known."""
    return f"{config.iterations} steps" + (
        f", at most {config.max_epochs} epochs" if config.max_epochs is not None else ""
    )
