"""The training loop, read from top to bottom."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from avatar.check import describe_non_finite
from avatar.checkpoint import Checkpoint, load_module, module_tensors, save_checkpoint
from avatar.config import Config, TrainerConfig
from avatar.data.loader import FrameLoader
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.losses import Perceptual, PhotometricLoss, dssim, masked_lpips, on_crop, photometric_loss
from avatar.lpips import Net, load_lpips
from avatar.model import Avatar
from avatar.splat import splat
from avatar.train.colours import colour_from_frames
from avatar.train.log import TrainingLog
from avatar.train.optim import load_optimizer, make_optimizer, optimizer_tensors, schedule, set_rates
from avatar.train.order import frame_order
from avatar.train.posed import PosedMeshes
from avatar.types import Frame


@dataclass(frozen=True)
class PerceptualTerm:
    """What the third term of the loss is in this run."""

    function: Perceptual | None
    weight: float
    name: str
    every: int = 1  # takes part in every so many-th step, with so many times the weight
    crop: int | None = None  # pixels; of a random square of the head in place of the frame

    def at(self, step: int, start: int, seed: int) -> tuple[Perceptual | None, float]:
        """Function and weight of step `step` (from 0) when the term takes part from step `start` on."""
        if self.function is None or step < start or (step - start) % self.every:
            return None, 0.0
        function = self.function
        if self.crop is not None:
            function = on_crop(function, self.crop, np.random.default_rng([seed, step]))
        return function, self.weight * self.every


def train(
    avatar: Avatar,
    subject: Subject,
    config: Config,
    run: Path,
    *,
    resume: Checkpoint | None = None,
    say: Callable[[str], None] = print,
) -> int:
    """Train `avatar` on the subject's training frames and write checkpoints, curves and previews into `run`.

    Returns the number of steps done when it ends, which is less than `trainer.iterations` after an interruption (Ctrl-C
    or SIGTERM; the state is saved first). Raises UserError, leaving the last good checkpoint, when a loss or gradient is
    not finite.
    """
    trainer = config.trainer
    perceptual = choose_perceptual(trainer, say)
    optimizer = make_optimizer(avatar, trainer)
    start = 0
    if resume is not None:
        load_module(avatar, resume, run)
        load_optimizer(optimizer, avatar, resume.tensors)
        start = resume.step
    elif trainer.initial_colours == "frames":
        colour_from_frames(avatar, subject, config.data.size)
    meshes = PosedMeshes(avatar.head)
    background = torch.tensor(config.data.background)
    perceptual_from = round(trainer.perceptual_start * trainer.iterations)
    meta = {
        "head_fingerprint": avatar.head.assets.fingerprint,
        "data_hash": subject.data_hash,
        "config": config.to_dict(),
        "perceptual": perceptual.name,
        "threads": torch.get_num_threads(),
    }

    def save(step: int) -> None:
        tensors = {**module_tensors(avatar), **optimizer_tensors(optimizer, avatar)}
        save_checkpoint(run / "checkpoints", Checkpoint(step, tensors, meta), trainer.keep_checkpoints)

    order = list(frame_order(subject.split.train, trainer.seed, start, trainer.iterations))
    step = saved = start
    with (
        FrameLoader(subject, config.data.size, config.data.cache_mb << 20, config.data.workers) as loader,
        TrainingLog(run, start, trainer.iterations, trainer.log_every) as log,
        interruption() as interrupted,
    ):
        for frame in loader.frames(order):
            target = frame.composite(background)
            degree = min(step // trainer.sh_interval, avatar.config.sh_degree)
            gaussians = avatar(frame.params, meshes.vertices(frame))
            rendering = splat(gaussians, frame.camera, background, sh_degree=degree)
            function, weight = perceptual.at(step, perceptual_from, trainer.seed)
            loss = photometric_loss(
                rendering.image,
                target,
                frame.mouth_mask,
                frame.head_mask,
                perceptual=function,
                perceptual_weight=weight,
                mouth_weight=trainer.mouth_weight,
                delta=trainer.huber_delta,
            )
            optimizer.zero_grad()
            loss.total.backward()
            check_step(step, frame, loss, avatar)
            set_rates(optimizer, schedule(step, trainer))
            optimizer.step()

            step += 1
            log.step(step, loss, rendering.image.detach(), target)
            if step % trainer.preview_every == 0 or step == trainer.iterations:
                log.preview(step, *render_held_out(avatar, loader, subject, background))
            if step % trainer.checkpoint_every == 0 or step == trainer.iterations:
                save(step)
                saved = step
            if interrupted():
                break
        if step > saved:
            save(step)
    return step


def choose_perceptual(config: TrainerConfig, say: Callable[[str], None]) -> PerceptualTerm:
    """LPIPS, D-SSIM or nothing. `auto` takes LPIPS when its weights are on this machine, else D-SSIM, and says so.

    Raises UserError when LPIPS is asked for by name and cannot be had.
    """
    if config.perceptual == "none":
        return PerceptualTerm(None, 0.0, "none")
    if config.perceptual in ("lpips", "auto"):
        try:
            lpips = load_lpips(cast(Net, config.lpips_net), download=config.perceptual == "lpips")
            name = f"lpips-{config.lpips_net}"
            return PerceptualTerm(
                masked_lpips(lpips), config.perceptual_weight, name, config.lpips_every, config.lpips_crop
            )
        except UserError as error:
            if config.perceptual == "lpips":
                raise
            say(f"Training with D-SSIM in place of LPIPS: {error}")
    return PerceptualTerm(dssim, config.dssim_weight, "dssim")


def check_step(step: int, frame: Frame, loss: PhotometricLoss, avatar: Avatar) -> None:
    """Stop before the optimizer when the loss or a gradient is not finite, naming the step, the frame and the tensor."""
    gradients: dict[str, Tensor] = {n: p.grad for n, p in avatar.named_parameters() if p.grad is not None}
    norm = torch.nn.utils.get_total_norm(gradients.values())
    if bool(torch.isfinite(norm + loss.total.detach())):
        return
    suspects = {f"the loss term {n}": v for n, v in loss._asdict().items()}
    suspects |= {f"the gradient of {n}": g for n, g in gradients.items()}
    for name, tensor in suspects.items():
        if message := describe_non_finite(name, tensor.detach()):
            raise UserError(
                f"training stopped at step {step + 1}, frame {frame.name}: {message}; the last checkpoint is untouched, "
                "go on from it with --resume and lower learning rates, or leave the frame out"
            )
    # Every value is finite but a norm overflows float32: as useless to Adam as a NaN.
    raise UserError(f"training stopped at step {step + 1}, frame {frame.name}: a gradient's norm is beyond float32")


@torch.no_grad()
def render_held_out(avatar: Avatar, loader: FrameLoader, subject: Subject, background: Tensor) -> tuple[Tensor, Tensor]:
    """Truth and render of the first held-out frame."""
    frame = next(iter(loader.frames([subject.split.test[0]])))
    return frame.composite(background), splat(avatar(frame.params), frame.camera, background).image


@contextmanager
def interruption() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C or SIGTERM into a flag that the loop reads between steps; a second one acts at once.

    A signal that is ignored (a job in the background of a shell, nohup) stays ignored, and outside the main thread the
    signals are somebody else's.
    """
    caught = False
    previous: dict[int, Any] = {}

    def note(number: int, _: FrameType | None) -> None:
        nonlocal caught
        caught = True
        signal.signal(number, previous[number])

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) != signal.SIG_IGN:
                previous[number] = signal.signal(number, note)
    try:
        yield lambda: caught
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
