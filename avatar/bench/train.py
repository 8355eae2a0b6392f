"""Time of a training step, whole and by stage, of the paper's recipe and the default one: `avatar bench train FOLDER`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import cycle
from typing import Any

import torch

from avatar.bench import Request
from avatar.bench.clock import Time, paired_medians, time_of
from avatar.bench.floor import floor_ms
from avatar.bench.splat_gpu import settle
from avatar.bench.stages import StagedStep, with_stages
from avatar.compute.cuda_graph import own_stream
from avatar.compute.device import on_gpu
from avatar.config import Config, load_config
from avatar.data.gpu_frame_cache import GpuFrameCache, frame_cache_bytes
from avatar.data.loader import FrameLoader
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.gaussians.base_model import Avatar
from avatar.model import FlashAvatar
from avatar.runs.model_registry import make_avatar
from avatar.train.objective import Objective, choose_perceptual, perceptual_start
from avatar.train.optimizer import make_optimizer
from avatar.train.pose_corrections import make_pose_corrections
from avatar.train.step import Judge, TrainState
from avatar.train.step_monitor import Guard
from avatar.train.step_runner import WARM, StepRunner
from avatar.types import Frame
from data_prep.prepare.open import find_head, open_subject

RECIPES = {"paper": ("experiment=paper", "data.size=null", "trainer.perceptual=auto"), "default": ()}
FRAMES = 8  # training frames that take turns; all are decoded before the clock runs
ONCE_A_FRAME = ("skinning",)  # done once for each frame of a training, not in every step
QUICK = ("model.uv_size=20", "data.size=48", "model.mlp_width=16")


@dataclass(frozen=True)
class Row:
    """One recipe. Milliseconds; `late` steps have the perceptual term, whose sparse steps are averaged. Stages and their
    floors are the CPU's: a GPU's step is not cut."""

    recipe: str
    gaussians: int
    places: int  # at which the network is evaluated
    parameters: int
    early: Time
    late: Time
    stages: dict[str, Time]  # of a late step
    floors: dict[str, float]  # of the stages whose work can be counted, forward and backward together


@dataclass
class Learner:
    """An avatar in training and some frames."""

    config: Config
    state: TrainState
    frames: Iterator[Frame]
    steps: StepRunner
    judge: Judge | None  # None: every step is checked at once

    @property
    def avatar(self) -> Avatar:
        return self.state.avatar

    def step(self, number: int) -> None:
        self.steps.make(number, next(self.frames), self.judge)


def measure(request: Request, repeats: int, say: Callable[[str], None] = print) -> list[Row]:
    """Time both recipes in turns on the same frames. Raises UserError as `avatar train` does."""
    folder, overrides = request.inputs[0], [*(QUICK if request.quick else ()), *request.overrides]
    source = Source(folder, find_head(folder, request.head), request.tracking, request.frame_offset)
    subject, assets = open_subject(source, load_config(overrides).data.test_frames, say)
    learners = {}
    for recipe, own in RECIPES.items():
        config = load_config([*own, *overrides])
        torch.manual_seed(config.trainer.seed)
        avatar = make_avatar(assets, subject.identity, config.model)
        with torch.no_grad():  # opacities as after training: what is drawn decides what drawing costs
            avatar.opacity_logits.copy_(1.5 * torch.randn(len(avatar)) + 0.5)
        avatar.to(torch.device(request.device))
        learners[recipe] = make_learner(avatar, subject, config, say if recipe == "paper" else silent)
    steps: dict[tuple[str, bool], Callable[[], object]] = {}
    for recipe, learner in learners.items():
        for late in (False, True):
            steps[recipe, late] = lambda learner=learner, late=late: run_steps(learner, late)
    with own_stream(torch.device(request.device)):
        times = paired_medians(steps, repeats, warm_up=WARM + 1)
    return [
        Row(
            recipe,
            len(learner.avatar),
            len(with_stages(learner.avatar).code),
            sum(p.numel() for p in learner.avatar.parameters()),
            times[recipe, False],
            per_step(times[recipe, True], steps_at_once(learner)),
            {} if on_gpu(learner.avatar.quats) else stages(learner, subject, repeats),
            {} if on_gpu(learner.avatar.quats) else floors(with_stages(learner.avatar)),
        )
        for recipe, learner in learners.items()
    ]


def make_learner(
    avatar: Avatar, subject: Subject, config: Config, say: Callable[[str], None], perceptual: str | None = None
) -> Learner:
    """The avatar with a few decoded frames that are spread over the training split, all where the avatar is.

    `perceptual` is the recorded term of a run, which its steps are timed with; None chooses as a new run would.
    """
    train = subject.split.train
    chosen = [train[i * len(train) // FRAMES] for i in range(FRAMES)]
    device, is_gpu = avatar.device, on_gpu(avatar.quats)
    frame_cache = GpuFrameCache(subject, device, frame_cache_bytes(device)) if is_gpu else None
    with FrameLoader(subject, config.data.size, frame_cache=frame_cache) as loader:
        frames = list(loader.frames(chosen))
    term = choose_perceptual(config.trainer, say, perceptual, size=subject.image_size(config.data.size), device=device)
    objective = Objective(config.trainer, torch.tensor(config.data.background).to(device), term)
    corrections = make_pose_corrections(avatar, train, config.trainer)
    optimizer = make_optimizer(avatar, config.trainer, corrections)
    state = TrainState(avatar, optimizer, objective, corrections)
    judge = Guard(optimizer, device).judge if is_gpu else None
    steps = StepRunner(state, say=say)
    for frame in frames:
        steps.vertices(frame)
    return Learner(config, state, cycle(frames), steps, judge)


def silent(_: str) -> None:
    """What was said for one recipe holds for the other."""


def steps_at_once(learner: Learner) -> int:
    """So many steps hold one with the perceptual term."""
    return learner.state.objective.perceptual.every


def run_steps(learner: Learner, late: bool) -> None:
    """One step with all degrees of colour but before the perceptual term; or the last ones, as many as hold one with it."""
    iterations = learner.config.trainer.iterations
    if late:
        first = iterations // steps_at_once(learner) * steps_at_once(learner)
        for number in range(first, first + steps_at_once(learner)):
            learner.step(number)
    else:
        learner.step(perceptual_start(learner.config.trainer) - 1)
    settle(learner.avatar.device)


def per_step(time: Time, steps: int) -> Time:
    return Time(time.median / steps, time.p95 / steps, time.repeats)


def stages(learner: Learner, subject: Subject, repeats: int) -> dict[str, Time]:
    staged = StagedStep(learner.state)
    size = learner.config.data.size
    pixels = [
        (frame.index, subject.pixels(frame.index, size)) for frame in (next(learner.frames) for _ in range(FRAMES))
    ]
    number = learner.config.trainer.iterations // steps_at_once(learner) * steps_at_once(learner)
    for turn in range(repeats + 2):
        index, decoded = pixels[turn % len(pixels)]
        staged(number, lambda index=index, decoded=decoded: subject.assemble(index, decoded, size))
    return {name: time_of(values[2:]) for name, values in staged.watch.spans.items()}


def floors(avatar: FlashAvatar) -> dict[str, float]:
    """Milliseconds in which this machine does the products, or moves the bytes, that a stage cannot do without.

    Network: a product for the outputs, one for the weights' gradients and, behind the first layer, one for the inputs'.
    Heads: parameters and latents read twice, their gradients written once, offsets and their gradients moved once.
    Optimizer: parameters, gradients and both moments read, all but the gradients written. Check: gradients read.
    """
    threads, places, network = torch.get_num_threads(), len(avatar.code), avatar.deformation
    first, *others = [layer.weight for layer in network.modules() if isinstance(layer, torch.nn.Linear)]
    code = first[:, : network.code_size].numel()
    products = 2 * code + 3 * sum(weight.numel() for weight in others)
    everything = sum(parameter.nbytes for parameter in avatar.parameters())
    found = {
        "network": floor_ms(2.0 * places * products, 0.0, threads),
        "optimizer": floor_ms(0.0, 7.0 * everything, threads),
        "check": floor_ms(0.0, 1.0 * everything, threads),
    }
    if avatar.hyper is not None:
        own = sum(parameter.nbytes for parameter in avatar.hyper.parameters())
        moved = 3 * own + 4 * len(avatar) * (3 * avatar.config.latent_dim + 2 * 10)
        found["heads"] = floor_ms(0.0, moved, threads)
    return found


def share_of_faithful(rows: Sequence[Row]) -> dict[str, float]:
    """How many times faster each recipe's late step is than the first row's."""
    return {row.recipe: rows[0].late.median / row.late.median for row in rows}


def as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    return [asdict(row) for row in rows]
