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
from torch import Tensor

from avatar.bench import Request
from avatar.bench.perturb_tracking import disturbed
from avatar.bench.refine import Trial
from avatar.bench.results import write_report
from avatar.config import Config, load_config
from avatar.data.recording import Recording
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.demo.identity import sample_identity
from avatar.demo.motion import frame_camera, frame_params, perform
from avatar.demo.render import Renderer as Truth
from avatar.demo.subject import make_subject, tracking_bias
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.losses.metrics import psnr
from avatar.motion.statistics import learn_statistics
from avatar.motion.transfer import TRANSFERS, transfer_motion
from avatar.pipeline.refine_plan import WITH_REFINEMENT
from avatar.render import Renderer
from avatar.types import Camera, HeadParams
from data_prep.prepare.open import open_subject

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
    """Means over the driver's frames, dB."""

    tracking: str  # that the target's avatar was trained on
    transfer: str
    full: float  # the whole frame
    head: float  # inside the true head mask


def run(request: Request) -> None:
    scale = QUICK if request.quick else USUAL
    rows = measure(scale, request.out, request.overrides, TRACKINGS if request.full else TRACKINGS[:1])
    lines = [
        f"{'tracking':>12} {'transfer':>12} {'PSNR full':>10} {'PSNR head':>10}   dB, {scale.driver_frames} frames of "
        f"{scale.size} pixels"
    ]
    lines += [f"{row.tracking:>12} {row.transfer:>12} {row.full:10.2f} {row.head:10.2f}" for row in rows]
    content = {
        "scale": asdict(scale),
        "neutral_bias": NEUTRAL_BIAS,
        "overrides": request.overrides,
        "rows": [asdict(row) for row in rows],
    }
    write_report(request.out, "bench_transfer", lines, content)


def measure(
    scale: Scale, out: Path, overrides: Sequence[str] = (), trackings: Sequence[str] = TRACKINGS[:1]
) -> list[Row]:
    """Make both subjects, train the target's avatars, drive them in every way. All lies in a temporary folder."""
    config = load_config(
        [
            "experiment=demo",
            *WITH_REFINEMENT,
            f"data.size={scale.size}",
            f"trainer.iterations={scale.iterations}",
            *overrides,
        ]
    )
    performance = perform(DRIVER_SEED, scale.driver_frames, "speech")
    true = [frame_params(performance, i) for i in range(scale.driver_frames)]
    cameras = [frame_camera(performance, i, scale.size) for i in range(scale.driver_frames)]
    truth = true_pictures(true, cameras, config)
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
        for tracking, avatar, recording in avatars(target, assets, config, Path(scratch), trackings):
            statistics = learn_statistics(recording.motion(target.split.train), avatar.head)
            motions = {mode: transfer_motion(tracked, statistics, mode, driver_head).motion for mode in TRANSFERS}
            motions[CEILING] = [replace(params, expression=params.expression + own) for params in true]
            renderer = Renderer(avatar, torch.tensor(config.data.background))
            rows += [compare(tracking, name, renderer, motion, cameras, truth) for name, motion in motions.items()]
    return rows


def avatars(
    target: Subject, assets: HeadAssets, config: Config, scratch: Path, trackings: Sequence[str]
) -> Iterator[tuple[str, Avatar, Recording]]:
    """The target's avatars by the tracking that each was trained on, which is given too."""
    trial = Trial(target, assets, config, None, scratch)
    if GIVEN in trackings:
        yield GIVEN, trial.trained(target.recording, GIVEN), target.recording
    if DISTURBED in trackings:
        recording = disturbed(target.recording, HeadModel(assets, target.identity), DISTURBED_SEED)
        avatar = trial.trained(recording, DISTURBED)
        yield DISTURBED, avatar, recording
        better, _ = trial.refined(recording, f"{DISTURBED}, first")
        yield REFINED, trial.trained(better, REFINED), better


def true_pictures(
    motion: Sequence[HeadParams], cameras: Sequence[Camera], config: Config
) -> list[tuple[Tensor, Tensor]]:
    """The target performing the driver's motion, over the training's background, and the head masks."""
    person, background = Truth(sample_identity(TARGET_SEED)), torch.tensor(config.data.background)
    pictures = []
    for params, camera in zip(motion, cameras, strict=True):
        frame = person.render(params, camera)
        mask = torch.from_numpy((frame.head > 127).astype(np.float32))
        weight = (torch.from_numpy(frame.alpha).float() / 255.0 * mask)[..., None]
        image = torch.from_numpy(frame.image.copy()).float() / 255.0
        pictures.append((image * weight + background * (1.0 - weight), mask))
    return pictures


def compare(
    tracking: str,
    name: str,
    renderer: Renderer,
    motion: Sequence[HeadParams],
    cameras: Sequence[Camera],
    truth: Sequence[tuple[Tensor, Tensor]],
) -> Row:
    renders = renderer.stream(zip(motion, cameras, strict=True))
    full, head = [], []
    for render, (picture, mask) in zip(renders, truth, strict=True):
        image = render.image.clamp(0.0, 1.0)
        full.append(float(psnr(image, picture)))
        head.append(float(psnr(image, picture, mask)))
    return Row(tracking, name, sum(full) / len(full), sum(head) / len(head))
