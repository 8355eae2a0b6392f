"""The training loop, read from top to bottom."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from avatar.compute.cuda_graph import own_stream
from avatar.compute.device import CPU, on_gpu
from avatar.compute.interruption import interruption
from avatar.config import Config
from avatar.data.gpu_frame_cache import GpuFrameCache, frame_cache_bytes
from avatar.data.loader import FrameLoader
from avatar.data.split import evenly_spread
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.motion.neutral_pose import find_neutral
from avatar.runs.avatar_file import AVATAR_FILE, write_avatar
from avatar.runs.checkpoint import Checkpoint, load_module, module_tensors, save_checkpoint
from avatar.splat import CannotDraw, checked_drawings
from avatar.train.condition_noise import make_noise
from avatar.train.frame_order import frame_order
from avatar.train.log import TrainingLog
from avatar.train.loss import PerceptualTerm, TrainingLoss
from avatar.train.optimizer import load_optimizer, make_optimizer, optimizer_tensors
from avatar.train.pose_corrections import PREFIX, make_pose_corrections
from avatar.train.step import TrainState, non_finite_error
from avatar.train.step_monitor import AsyncStepMonitor, NonFiniteStep, SyncStepMonitor
from avatar.train.step_runner import StepRunner
from avatar.train.zoom import make_zoom


def train(
    avatar: Avatar,
    subject: Subject,
    config: Config,
    run: Path,
    perceptual: PerceptualTerm,
    *,
    resume: Checkpoint | None = None,
    device: torch.device = CPU,
) -> int:
    """Train `avatar` on the subject's training frames and write checkpoints, avatar file, curves and previews into `run`.

    The avatar is moved to `device`; what `perceptual` holds has to be there already.

    Returns the number of steps done when it ends, which is less than `trainer.iterations` after an interruption (Ctrl-C
    or SIGTERM; the state is saved first). Raises UserError, leaving the last good checkpoint, when the avatar cannot be
    drawn any more or a loss or gradient is not finite.
    """
    trainer = config.trainer
    start = 0
    if resume is not None:
        load_module(avatar, resume.tensors, run)
        start = resume.step
    else:
        initialize_from_frames(avatar, subject, config)
    recording = subject.recording
    if resume is None:
        avatar.learn_head_rotation(recording.tracks["R"][recording.times(recording.split.train)])
    neutral = find_neutral(recording.motion(recording.split.train), avatar.head)
    avatar.to(device)
    corrections = make_pose_corrections(avatar, recording.times(recording.split.train), trainer)
    optimizer = make_optimizer(avatar, trainer, corrections)
    background = torch.tensor(config.data.background).to(device)
    state = TrainState(avatar, optimizer, TrainingLoss(trainer, background, perceptual), corrections)
    if resume is not None:
        if corrections is not None:
            corrections.load(resume.tensors)
        load_optimizer(optimizer, state.named_parameters(), resume.tensors)
    is_gpu = on_gpu(avatar.quats)
    meta = {
        "head_fingerprint": avatar.head.assets.fingerprint,
        "data_hash": subject.data_hash,
        "split": subject.split.to_lists(),
        "config": config.to_dict(),
        "perceptual": perceptual.name,
        "threads": torch.get_num_threads(),
        "device": device.type,
    }

    def save(step: int) -> None:
        tensors = module_tensors(avatar) | optimizer_tensors(optimizer, state.named_parameters())
        if corrections is not None:
            tensors[f"{PREFIX}moves"] = corrections.moves.detach()
        log.save()  # first: a resumed run has the curves up to its checkpoint, and leaves out what comes after
        save_checkpoint(run / "checkpoints", Checkpoint(step, tensors, meta))
        write_avatar(run / AVATAR_FILE, avatar, config, recording, neutral, step, perceptual.name)

    frame_cache = GpuFrameCache(subject, device, frame_cache_bytes(device)) if is_gpu else None
    step = saved = start
    with (
        own_stream(device),
        FrameLoader(subject, config.data.size, frame_cache=frame_cache) as loader,
        TrainingLog(run, start, trainer.iterations) as log,
        interruption() as interrupted,
    ):
        progress = AsyncStepMonitor(log, optimizer, device) if is_gpu else SyncStepMonitor(log)
        steps = StepRunner(state, make_noise(recording, trainer), make_zoom(avatar, recording, trainer), log.say)
        order = frame_order(subject.split.train, trainer.seed, step, trainer.iterations)
        try:
            for frame in loader.frames(order):
                outcome = steps.make(step, frame, progress.check_gradients)
                step += 1
                progress.note(step, outcome)
                saves = step % trainer.checkpoint_every == 0 or step == trainer.iterations
                stops = interrupted()  # asked once: what is saved for it is done, too
                if saves or stops:
                    progress.flush()
                if saves:
                    # What cannot be drawn is not saved.
                    pair = render_held_out(avatar, loader, subject, background, step)
                    save(step)
                    saved = step
                    log.preview(step, *pair)
                if stops:
                    break
        except NonFiniteStep as nonfinite:
            index = next(frame_order(subject.split.train, trainer.seed, nonfinite.step, trainer.iterations))
            frame = next(iter(loader.frames([index])))
            with checked_drawings():
                steps.make(nonfinite.step, frame, check_gradients=None)  # raises what was wrong
            raise non_finite_error(nonfinite.step + 1, frame, "the loss or a gradient was not finite") from nonfinite
        if step > saved:
            save(step)
    return step


def initialize_from_frames(avatar: Avatar, subject: Subject, config: Config) -> None:
    """Set what the avatar takes from training frames before its first step: `Avatar.initialize_from`.

    Raises UserError where the model has no surface to fit.
    """
    start = config.trainer.initialization
    if start == "surface" and not avatar.has_surface:
        raise UserError(
            f"trainer.initialization=surface is for model=gaussianheadavatar: the Gaussians of {config.model.name} start "
            "on the mesh; leave it out"
        )
    # Camera by camera: in order of time, a regular step can be a multiple of their number, and leave most of them out.
    train = sorted(subject.split.train, key=subject.recording.view)
    chosen = evenly_spread(train, avatar.initial_frames)
    frames = (subject.frame(index, config.data.size) for index in chosen)
    avatar.initialize_from(frames, start)


def save_avatar(
    run: Path, avatar: Avatar, checkpoint: Checkpoint, subject: Subject, config: Config, perceptual: str
) -> None:
    """Write the avatar file of a checkpoint, as training does with each that it saves."""
    load_module(avatar, checkpoint.tensors, run)
    recording = subject.recording
    neutral = find_neutral(recording.motion(recording.split.train), avatar.head)
    write_avatar(run / AVATAR_FILE, avatar, config, recording, neutral, checkpoint.step, perceptual)


@torch.no_grad()
def render_held_out(
    avatar: Avatar, loader: FrameLoader, subject: Subject, background: Tensor, step: int
) -> tuple[Tensor, Tensor]:
    """Truth and render of the first held-out frame after `step` steps. Raises UserError when it cannot be drawn."""
    frame = next(iter(loader.frames([subject.split.test[0]])))
    try:
        gaussians = avatar(frame.params, None, frame.camera.head_rotation)
        with checked_drawings():
            drawn = avatar.draw(gaussians, frame.camera, background)
    except CannotDraw as error:
        raise non_finite_error(step, frame, str(error)) from error
    return frame.composite(background), drawn.image
