"""Which expression transfer comes nearest to the truth, on two demo subjects whose tracked neutral faces differ.

The generator renders the target performing the driver's true motion, which no real recording has. `true motion` gives the
avatar that motion as the target's own tracking would have seen it: what is lost there is the avatar's fault, not the
transfer's.

With --full two more avatars of the target are driven in the same ways: one trained on a tracking that errs as trackers do,
and one trained on that tracking refined. Were refined coefficients a code that only their own avatar understands, the
driver's, which are not refined, would drive that avatar worse.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from avatar.bench import Request
from avatar.bench.figures import Figures, head_figures
from avatar.bench.perturb_tracking import perturbed
from avatar.bench.refine import Trial
from avatar.bench.results import write_report
from avatar.config import Config, load_config
from avatar.data.frame import Frame
from avatar.data.recording import Recording
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.demo.identity import sample_identity
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.render import Renderer as Truth
from avatar.demo.subject import make_subject, tracking_bias
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.motion.statistics import learn_statistics
from avatar.motion.transfer import TRANSFERS, transfer_motion
from avatar.types import Camera, HeadParams
from data_prep.prepare.open_subject import open_subject

TARGET_SEED, DRIVER_SEED = 1, 2
NEUTRAL_BIAS = 0.15  # standard deviation of a tracked coefficient at rest
CEILING = "true motion"
GIVEN, DISTURBED, REFINED = TRACKINGS = ("as given", "disturbed", "refined")
DISTURBED_SEED = 0


@dataclass(frozen=True)
class Scale:
    """How large the experiment is."""

    size: int  # pixels
    target_frames: int
    driver_frames: int
    iterations: int


# Of 500 frames, the target turns as far as the driver; of 400 it does not, and what it never showed decides.
USUAL, QUICK = Scale(160, 500, 60, 1500), Scale(64, 60, 16, 150)


@dataclass(frozen=True)
class Row:
    tracking: str  # that the target's avatar was trained on
    transfer: str
    figures: Figures  # over the driver's frames


def run(request: Request) -> None:
    scale = QUICK if request.quick else USUAL
    rows = measure(scale, request.out, request.overrides, request.full)
    lines = [
        f"{'tracking':>12} {'transfer':>12} {'PSNR head':>10}   dB, {scale.driver_frames} frames of {scale.size} pixels"
    ]
    lines += [f"{row.tracking:>12} {row.transfer:>12} {row.figures.psnr:10.2f}" for row in rows]
    content = {
        "scale": asdict(scale),
        "neutral_bias": NEUTRAL_BIAS,
        "overrides": request.overrides,
        "rows": [asdict(row) for row in rows],
    }
    write_report(request.out, "bench_transfer", lines, content)


def measure(scale: Scale, out: Path, overrides: Sequence[str] = (), full: bool = False) -> list[Row]:
    """Make both subjects, train the target's avatars, drive them in every way. All lies in a temporary folder."""
    config = load_config(
        [
            "experiment=demo",
            f"data.size={scale.size}",
            f"trainer.iterations={scale.iterations}",
            *overrides,
        ]
    )
    performance = perform(DRIVER_SEED, scale.driver_frames, "speech")
    true = [frame_params(performance, i) for i in range(scale.driver_frames)]
    cameras = [frame_camera(performance, i, scale.size) for i in range(scale.driver_frames)]
    truth = true_frames(true, cameras)
    with tempfile.TemporaryDirectory(dir=out) as scratch:
        target_folder, driver_folder = Path(scratch) / "target", Path(scratch) / "driver"
        make_subject(target_folder, scale.target_frames, scale.size, TARGET_SEED, neutral_bias=NEUTRAL_BIAS)
        make_subject(driver_folder, scale.driver_frames, scale.size, DRIVER_SEED, neutral_bias=NEUTRAL_BIAS)
        target, assets = open_subject(
            Source(target_folder, target_folder / "head_model", frame_offset=1), config.data.test_frames
        )
        driver, _ = open_subject(Source(driver_folder, target_folder / "head_model", frame_offset=1), assets=assets)
        driver_head = HeadModel(assets, driver.identity)
        tracked = [driver.params(i) for i in range(len(driver))]
        own = tracking_bias(TARGET_SEED, NEUTRAL_BIAS).expression
        rows = []
        for tracking, avatar, recording in avatars(target, assets, config, Path(scratch), full):
            statistics = learn_statistics(recording.motion(target.split.train), avatar.head)
            motions = {mode: transfer_motion(tracked, statistics, mode, driver_head).motion for mode in TRANSFERS}
            motions[CEILING] = [replace(params, expression=params.expression + own) for params in true]
            for name, motion in motions.items():
                driven = list(zip(motion, cameras, truth, strict=True))
                rows.append(Row(tracking, name, head_figures(avatar, torch.tensor(config.data.background), driven)))
    return rows


def avatars(
    target: Subject, assets: HeadAssets, config: Config, scratch: Path, full: bool
) -> Iterator[tuple[str, Avatar, Recording]]:
    """The target's avatars by the tracking that each was trained on, which is given too."""
    trial = Trial(target, assets, config, scratch)
    yield GIVEN, trial.trained(target.recording, GIVEN), target.recording
    if full:
        recording = perturbed(target.recording, HeadModel(assets, target.identity), DISTURBED_SEED)
        avatar = trial.trained(recording, DISTURBED)
        yield DISTURBED, avatar, recording
        better = trial.refined(recording, f"{DISTURBED}, first")
        yield REFINED, trial.trained(better, REFINED), better


def true_frames(motion: Sequence[HeadParams], cameras: Sequence[Camera]) -> list[Frame]:
    """The target performing the driver's motion."""
    person, frames = Truth(sample_identity(TARGET_SEED)), []
    for index, (params, camera) in enumerate(zip(motion, cameras, strict=True)):
        picture = person.render(params, camera)
        head = np.where(picture.head > 127, np.uint8(255), np.uint8(0))
        pixels = (picture.image, picture.alpha, head, picture.mouth)
        image, alpha, head_mask, mouth_mask = (torch.from_numpy(p).float() / 255.0 for p in pixels)
        frames.append(Frame(index, str(index), camera, params, image, alpha, head_mask, mouth_mask))
    return frames
