"""Which expression transfer comes nearest to the truth, on two demo subjects whose tracked neutral faces differ.

The generator renders the target performing the driver's true motion, which no real recording has. `true motion` gives the
avatar that motion as the target's own tracking would have seen it: what is lost there is the avatar's fault, not the
transfer's.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar.bench import Request
from avatar.bench.results import leave
from avatar.commands.opening import split_sizes
from avatar.config import Config, load_config
from avatar.data.source import Source
from avatar.demo.identity import sample_identity
from avatar.demo.motion import frame_camera, frame_params, perform
from avatar.demo.render import Renderer as Truth
from avatar.demo.subject import make_subject, tracking_bias
from avatar.head.model import HeadModel
from avatar.losses.metrics import psnr
from avatar.model import Avatar
from avatar.motion.repertoire import learn_repertoire
from avatar.motion.transfer import TRANSFERS, transfer_motion
from avatar.render import Renderer
from avatar.train.step import choose_perceptual
from avatar.train.trainer import train
from avatar.types import Camera, HeadParams
from data_prep.open import open_subject

TARGET_SEED, DRIVER_SEED = 1, 2
NEUTRAL_BIAS = 0.15  # standard deviation of a tracked coefficient at rest
CEILING = "true motion"


@dataclass(frozen=True)
class Scale:
    """How large the experiment is."""

    size: int  # pixels
    target_frames: int
    driver_frames: int
    iterations: int


USUAL, QUICK = Scale(160, 400, 60, 1500), Scale(64, 60, 16, 150)


@dataclass(frozen=True)
class Row:
    """Means over the driver's frames, dB."""

    transfer: str
    full: float  # the whole frame
    head: float  # inside the true head mask


def run(request: Request) -> None:
    scale = QUICK if request.quick else USUAL
    rows = measure(scale, request.out, request.overrides)
    lines = [
        f"{'transfer':>12} {'PSNR full':>10} {'PSNR head':>10}   dB, {scale.driver_frames} frames of {scale.size} pixels"
    ]
    lines += [f"{row.transfer:>12} {row.full:10.2f} {row.head:10.2f}" for row in rows]
    content = {
        "scale": asdict(scale),
        "neutral_bias": NEUTRAL_BIAS,
        "overrides": request.overrides,
        "rows": [asdict(row) for row in rows],
    }
    leave(request.out, "bench_transfer", lines, content)


def measure(scale: Scale, out: Path, overrides: Sequence[str] = ()) -> list[Row]:
    """Make both subjects, train the target's avatar, drive it in every way. Everything lies in a temporary folder."""
    config = load_config(
        ["experiment=demo", f"data.size={scale.size}", f"trainer.iterations={scale.iterations}", *overrides]
    )
    with tempfile.TemporaryDirectory(dir=out) as scratch:
        target_folder, driver_folder = Path(scratch) / "target", Path(scratch) / "driver"
        make_subject(target_folder, scale.target_frames, scale.size, TARGET_SEED, neutral_bias=NEUTRAL_BIAS)
        make_subject(driver_folder, scale.driver_frames, scale.size, DRIVER_SEED, neutral_bias=NEUTRAL_BIAS)
        target, assets = open_subject(
            Source(target_folder, target_folder / "head_model", frame_offset=1), split_sizes(config)
        )
        driver, _ = open_subject(Source(driver_folder, target_folder / "head_model", frame_offset=1), assets=assets)
        torch.manual_seed(config.trainer.seed)
        avatar = Avatar(assets, target.identity, config.model)
        term = choose_perceptual(config.trainer, print, size=target.image_size(config.data.size))
        train(avatar, target, config, Path(scratch) / "run", term)
        tracked = [driver.params(i) for i in range(len(driver))]
        repertoire = learn_repertoire(target.recording.motion(target.split.train), avatar.head)
        driver_head = HeadModel(assets, driver.identity)
    own = tracking_bias(TARGET_SEED, NEUTRAL_BIAS).expression
    performance = perform(DRIVER_SEED, scale.driver_frames, "speech")
    true = [frame_params(performance, i) for i in range(scale.driver_frames)]
    cameras = [frame_camera(performance, i, scale.size) for i in range(scale.driver_frames)]
    motions = {mode: transfer_motion(tracked, repertoire, mode, driver_head).motion for mode in TRANSFERS}
    motions[CEILING] = [replace(params, expression=params.expression + own) for params in true]
    truth = true_pictures(true, cameras, config)
    renderer = Renderer(avatar, torch.tensor(config.data.background))
    return [compare(name, renderer, motion, cameras, truth) for name, motion in motions.items()]


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
    return Row(name, sum(full) / len(full), sum(head) / len(head))
