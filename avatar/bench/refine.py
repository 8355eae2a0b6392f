"""What refinement gives back of what trackers' errors take: a subject's tracking disturbed, refined and trained on again.

The folder's own tracking stands for the truth, and its last frames, which no training sees, are measured. Four avatars of
the same recipe: trained on the tracking as given, on the disturbed one, and on both as `avatar train --refine 1` refines
them, through an avatar that is only trained for that.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from avatar.bench import Request
from avatar.bench.perturb_tracking import COEFFICIENT_SHARE, SHIFT_MM, TURN_DEGREES, disturbed
from avatar.bench.results import write_report
from avatar.config import Config, load_config
from avatar.data.recording import Recording
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.evaluation.lpips_networks import find_lpips
from avatar.evaluation.measure import lpips_in_mask, to_8_bit
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.losses.lpips_network import Lpips
from avatar.losses.metrics import psnr, ssim
from avatar.pipeline.refine_plan import WITH_REFINEMENT, round_steps
from avatar.pose_refinement.motion import EXPRESSION, values_of
from avatar.pose_refinement.refine import refine_subject
from avatar.render import Renderer
from avatar.runs.model_registry import make_avatar
from avatar.train.objective import choose_perceptual
from avatar.train.order import planned_steps, within_passes
from avatar.train.trainer import train
from data_prep.prepare.open import find_head, open_subject

SEED = 0
MEASURED_EVERY = 2  # held-out frames
GIVEN, DISTURBED, REFINED, GIVEN_REFINED = "as given", "disturbed", "disturbed, refined", "given, refined"
RANGE_TOLERANCE = 1e-6  # of a coefficient: rounding
QUICK = ("data.size=64", "model.uv_size=24", "model.mlp_width=24", "trainer.iterations=60")


@dataclass(frozen=True)
class Figures:
    """Held-out frames, the head mask alone; means over frames of 8-bit pictures."""

    psnr: float  # dB
    ssim: float
    lpips: float
    mouth: float  # PSNR, dB


@dataclass(frozen=True)
class Row:
    """One avatar: the tracking that it was trained on, and how it draws held-out frames."""

    tracking: str
    own: Figures  # driven by that tracking
    before: Figures | None  # driven by what that tracking was before its refinement
    given: Figures  # driven by the tracking as given
    vertices_mm: float  # of that tracking against the given one, held-out frames
    vertices_px: float
    outside: int  # expression coefficients outside the range of the training frames, that were inside before
    refine_seconds: float | None


def run(request: Request) -> None:
    (folder,) = request.inputs
    config = load_config(
        [*WITH_REFINEMENT, *(QUICK if request.quick else ()), "trainer.checkpoint_every=1000000", *request.overrides]
    )
    source = Source(folder, find_head(folder, request.head), request.tracking, request.frame_offset)
    rows = measure(source, config, request.out)
    content = {
        "folder": folder.resolve().name,
        "config": config.to_dict(),
        "disturbance": {"degrees": TURN_DEGREES, "mm": SHIFT_MM, "coefficients": COEFFICIENT_SHARE, "seed": SEED},
        "recovered": recovered(rows),
        "rows": [asdict(row) for row in rows],
    }
    write_report(request.out, f"bench_refine_{folder.resolve().name}", report(rows, config).splitlines(), content)


def measure(source: Source, config: Config, out: Path) -> list[Row]:
    """Train and refine; what is written on the way lies in a temporary folder."""
    subject, assets = open_subject(source, config.data.test_frames, print)
    network, note = find_lpips("squeeze")
    print(f"LPIPS: {note}")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(dir=out) as scratch:
        trial = Trial(subject, assets, config, network, Path(scratch))
        bent = disturbed(subject.recording, HeadModel(assets, subject.identity), SEED)
        for name, recording, again in ((GIVEN, subject.recording, GIVEN_REFINED), (DISTURBED, bent, REFINED)):
            avatar = trial.trained(recording, name)
            rows.append(trial.row(name, avatar, recording))
            better, seconds = trial.refined(recording, f"{name}, first")
            avatar = trial.trained(better, again)
            rows.append(trial.row(again, avatar, better, recording, seconds))
    return rows


@dataclass(frozen=True)
class Trial:
    """One subject, whose own recording counts as the truth."""

    subject: Subject
    assets: HeadAssets
    config: Config
    network: Lpips | None
    scratch: Path

    def trained(self, recording: Recording, name: str) -> Avatar:
        """An avatar of the subject's pictures with this tracking. Raises KeyboardInterrupt after an interruption."""
        trainer = within_passes(self.config.trainer, len(recording.split.train))
        config, subject = replace(self.config, trainer=trainer), replace(self.subject, recording=recording)
        torch.manual_seed(config.trainer.seed)
        avatar = make_avatar(self.assets, subject.identity, config.model)
        term = choose_perceptual(config.trainer, print, size=subject.image_size(config.data.size))
        if train(avatar, subject, config, self.scratch / name, term) < config.trainer.iterations:
            raise KeyboardInterrupt
        return avatar.eval()

    def refined(self, recording: Recording, name: str) -> tuple[Recording, float]:
        """The tracking refined through a shortly trained avatar, and the seconds that refining took.

        Raises KeyboardInterrupt after an interruption.
        """
        frames = len(recording.split.train)
        trainer = within_passes(self.config.trainer, frames)
        steps = round_steps(trainer.iterations, frames)
        short = replace(self.config, trainer=replace(trainer, iterations=steps))
        avatar = replace(self, config=short).trained(recording, name)
        begin = time.perf_counter()
        background = torch.tensor(self.config.data.background)
        subject = replace(self.subject, recording=recording)
        found = refine_subject(avatar, subject, self.config.data.size, background, self.scratch / "progress")
        if found is None:
            raise KeyboardInterrupt
        return replace(recording, tracks=found.tracks), time.perf_counter() - begin

    def row(
        self,
        name: str,
        avatar: Avatar,
        recording: Recording,
        before: Recording | None = None,
        seconds: float | None = None,
    ) -> Row:
        mm, px = vertex_errors(avatar.head, recording, self.subject.recording)
        return Row(
            tracking=name,
            own=self.figures(avatar, recording),
            before=None if before is None else self.figures(avatar, before),
            given=self.figures(avatar, self.subject.recording),
            vertices_mm=mm,
            vertices_px=px,
            outside=0 if before is None else coefficients_outside(recording, before),
            refine_seconds=seconds,
        )

    def figures(self, avatar: Avatar, recording: Recording) -> Figures:
        """Of the held-out frames driven by a recording."""
        shown = [(index, index) for index in recording.split.test[::MEASURED_EVERY]]
        return figures(avatar, recording, self.subject, shown, self.config, self.network)


def figures(
    avatar: Avatar,
    recording: Recording,
    truth: Subject,
    shown: Sequence[tuple[int, int]],
    config: Config,
    network: Lpips | None,
) -> Figures:
    """Of the avatar driven by some frames of a recording, against the true subject's pictures in its head masks.

    `shown` are the frames' indices in the recording and in the true subject.
    """
    size, background = config.data.size, torch.tensor(config.data.background)
    renderer = Renderer(avatar, background)
    found = []
    for index, true_index in shown:
        frame = truth.frame(true_index, size)
        image = renderer.render(recording.params(index), recording.camera(index, size)).image
        render, picture = (to_8_bit(pixels).double() / 255.0 for pixels in (image, frame.composite(background)))
        mask, mouth = frame.head_mask.double(), frame.mouth_mask.double()
        found.append(
            (
                float(psnr(render, picture, mask)),
                float(ssim(render, picture, mask)),
                lpips_in_mask(network, (render, picture), mask),
                float(psnr(render, picture, mouth)),
            )
        )
    return Figures(*(_mean(np.array(column)) for column in zip(*found, strict=True)))


def vertex_errors(head: HeadModel, recording: Recording, truth: Recording) -> tuple[float, float]:
    """How far vertices are from where the truth has them, as the camera sees them: mm, and pixels of the video.

    Root mean squares over the vertices, means over the held-out frames.
    """
    distances = []
    for index in recording.split.test:
        (ours, own_camera), (theirs, camera) = (
            (head.vertices(one.params(index)), one.camera(index)) for one in (recording, truth)
        )
        places = [v @ c.R_cam_world.T + c.t_cam_world for v, c in ((ours, own_camera), (theirs, camera))]
        screens = [c.project(v)[:, :2] for v, c in ((ours, own_camera), (theirs, camera))]
        distances.append([float((a - b).square().sum(dim=1).mean().sqrt()) for a, b in (places, screens)])
    mm, px = np.mean(distances, axis=0).tolist()
    return 1e3 * mm, px


def coefficients_outside(recording: Recording, before: Recording) -> int:
    """Expression coefficients of any frame outside the range that training frames had before, which were inside it then."""
    now, then = (values_of(one.tracks)[:, EXPRESSION] for one in (recording, before))
    training = then[list(before.split.train)]
    low, high = training.amin(dim=0) - RANGE_TOLERANCE, training.amax(dim=0) + RANGE_TOLERANCE
    left = ((now < low) | (now > high)) & (then >= low) & (then <= high)
    return int(left.sum())


def recovered(rows: Sequence[Row]) -> float:
    """The share of the PSNR lost by the disturbance that refining and training again brought back."""
    by_name = {row.tracking: row.own.psnr for row in rows}
    return (by_name[REFINED] - by_name[DISTURBED]) / (by_name[GIVEN] - by_name[DISTURBED])


def report(rows: Sequence[Row], config: Config) -> str:
    head = f"{'PSNR':>7}{'SSIM':>8}{'LPIPS':>8}{'mouth':>7}"
    lines = [
        f"Held-out frames, head alone, {planned_steps(config.trainer)}. Driven by what the tracking was before refining, "
        "by the tracking that was trained on (own; where refined, fitted to these frames' pictures), and by the given one",
        f"{'trained on':>20} {'before'.center(30)} {'own'.center(30)} {'given'.center(30)}   vertices, mm and px  outside",
        f"{'':>20} {head} {head} {head}",
    ]
    for row in rows:
        cells = " ".join(_cells(figures) for figures in (row.before, row.own, row.given))
        lines.append(f"{row.tracking:>20} {cells} {row.vertices_mm:12.3f} {row.vertices_px:7.3f} {row.outside:8d}")
    seconds = [row.refine_seconds for row in rows if row.refine_seconds is not None]
    lines += [
        "",
        f"{recovered(rows):.0%} of the PSNR lost by the disturbance came back; refining took "
        f"{' and '.join(f'{value:.0f}' for value in seconds)} s",
    ]
    return "\n".join(lines)


def _cells(figures: Figures | None) -> str:
    if figures is None:
        return " " * 30
    return f"{figures.psnr:7.2f}{figures.ssim:8.4f}{figures.lpips:8.4f}{figures.mouth:7.2f}"


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")
