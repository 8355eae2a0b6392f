"""Time of a training step, whole and by stage, of the paper's recipe and the default one: `avatar bench train SUBJECT`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import cycle

import torch

from avatar.bench import Request
from avatar.bench.clock import Time, paired_medians, synchronize
from avatar.bench.results import write_report
from avatar.bench.roofline import roofline_ms
from avatar.bench.stages import Stopwatch
from avatar.compute.cuda_graph import own_stream
from avatar.compute.device import on_gpu
from avatar.config import Config, load_config
from avatar.data.frame import Frame
from avatar.data.gpu_frame_cache import GpuFrameCache, frame_cache_bytes
from avatar.data.loader import FrameLoader
from avatar.data.source import Source
from avatar.data.split import evenly_spread
from avatar.data.subject import Subject
from avatar.gaussians.base_model import Avatar
from avatar.model import FlashAvatar
from avatar.runs.model_registry import make_avatar
from avatar.train import step as train_step
from avatar.train.loss import TrainingLoss, choose_perceptual, perceptual_start
from avatar.train.optimizer import make_optimizer
from avatar.train.pose_corrections import make_pose_corrections
from avatar.train.step import GradientCheck, TrainState
from avatar.train.step_monitor import Guard
from avatar.train.step_runner import WARM, StepRunner
from data_prep.prepare.open_subject import find_head, open_subject

REPEATS, QUICK_REPEATS, FULL_REPEATS = 15, 2, 41
RECIPES = {"paper": ("experiment=paper", "data.size=null", "trainer.perceptual=auto"), "default": ()}
FRAMES = 8  # training frames that take turns; all are decoded before the clock runs
QUICK = ("model.uv_size=20", "data.size=48", "model.mlp_width=16")


@dataclass(frozen=True)
class Row:
    """One recipe. Milliseconds; `late` steps have the perceptual term, whose sparse steps are averaged."""

    recipe: str
    gaussians: int
    places: int  # at which the network is evaluated
    parameters: int
    early: Time
    late: Time
    stages: dict[str, Time]  # of a late step with the perceptual term; none on a GPU, which is not waited for in a step
    floors: dict[str, float]  # milliseconds, of the stages whose work can be counted, forward and backward together


@dataclass
class Learner:
    """An avatar in training and some frames."""

    config: Config
    state: TrainState
    frames: Iterator[Frame]
    steps: StepRunner
    check_gradients: GradientCheck | None  # None: every step is checked at once

    @property
    def avatar(self) -> Avatar:
        return self.state.avatar

    def step(self, number: int) -> None:
        self.steps.make(number, next(self.frames), self.check_gradients)


def run(request: Request) -> None:
    """Measure, print and write; `quick` takes an avatar too small to say anything."""
    repeats = QUICK_REPEATS if request.quick else FULL_REPEATS if request.full else REPEATS
    rows = measure(request, repeats)
    content = {
        "folder": str(request.inputs[0]),
        "overrides": list(request.overrides),
        "rows": [asdict(row) for row in rows],
    }
    write_report(request.out, "bench_train", table(rows), content)


def measure(request: Request, repeats: int) -> list[Row]:
    """Time both recipes in turns on the same frames. Raises UserError as `avatar train` does."""
    folder, overrides = request.inputs[0], [*(QUICK if request.quick else ()), *request.overrides]
    source = Source(folder, find_head(folder, request.head), request.tracking, request.frame_offset)
    subject, assets = open_subject(source, load_config(overrides).data.test_frames, print)
    device = torch.device(request.device)
    learners = {}
    for recipe, own in RECIPES.items():
        config = load_config([*own, *overrides])
        torch.manual_seed(config.trainer.seed)
        avatar = make_avatar(assets, subject.identity, config.model)
        with torch.no_grad():  # opacities as after training: what is drawn decides what drawing costs
            avatar.opacity_logits.copy_(1.5 * torch.randn(len(avatar)) + 0.5)
        learners[recipe] = make_learner(avatar.to(device), subject, config, print)
    with own_stream(device):
        times = time_steps(list(learners.values()), repeats, warm_up=WARM + 1)
    return [
        Row(
            recipe,
            len(learner.avatar),
            len(learner.avatar.code) if isinstance(learner.avatar, FlashAvatar) else 0,
            sum(p.numel() for p in learner.avatar.parameters()),
            early,
            late,
            {} if on_gpu(learner.avatar.quats) else stages(learner, repeats),
            {} if on_gpu(learner.avatar.quats) else floors(learner.avatar),
        )
        for (recipe, learner), (early, late) in zip(learners.items(), times, strict=True)
    ]


def make_learner(
    avatar: Avatar, subject: Subject, config: Config, say: Callable[[str], None], perceptual: str | None = None
) -> Learner:
    """The avatar with a few decoded frames that are spread over the training split, all where the avatar is.

    `perceptual` is the recorded term of a run, which its steps are timed with; None chooses as a new run would.
    """
    train = subject.split.train
    chosen = evenly_spread(train, FRAMES)
    device, is_gpu = avatar.device, on_gpu(avatar.quats)
    frame_cache = GpuFrameCache(subject, device, frame_cache_bytes(device)) if is_gpu else None
    with FrameLoader(subject, config.data.size, frame_cache=frame_cache) as loader:
        frames = list(loader.frames(chosen))
    term = choose_perceptual(config.trainer, say, perceptual, size=subject.image_size(config.data.size), device=device)
    objective = TrainingLoss(config.trainer, torch.tensor(config.data.background).to(device), term)
    corrections = make_pose_corrections(avatar, subject.recording.times(train), config.trainer)
    optimizer = make_optimizer(avatar, config.trainer, corrections)
    state = TrainState(avatar, optimizer, objective, corrections)
    check_gradients = Guard(optimizer, device).check_gradients if is_gpu else None
    steps = StepRunner(state, say=say)
    for frame in frames:
        steps.vertices(frame)
    return Learner(config, state, cycle(frames), steps, check_gradients)


def time_steps(learners: Sequence[Learner], repeats: int, warm_up: int = 2) -> list[tuple[Time, Time]]:
    """Milliseconds of an early and a late step of each, taken in turns."""
    steps: dict[tuple[int, bool], Callable[[], object]] = {}
    for index, learner in enumerate(learners):
        for late in (False, True):
            steps[index, late] = lambda learner=learner, late=late: run_steps(learner, late)
    times = paired_medians(steps, repeats, warm_up=warm_up)
    return [
        (times[index, False], per_step(times[index, True], steps_at_once(learner)))
        for index, learner in enumerate(learners)
    ]


def run_steps(learner: Learner, late: bool) -> None:
    """One step with all degrees of colour but before the perceptual term; or the last ones, as many as hold one with it."""
    if late:
        for number in range(steps_at_once(learner)):
            learner.step(first_late_step(learner) + number)
    else:
        learner.step(perceptual_start(learner.config.trainer) - 1)
    synchronize(learner.avatar.device)


def steps_at_once(learner: Learner) -> int:
    """So many steps hold one with the perceptual term."""
    return learner.state.objective.perceptual.every


def first_late_step(learner: Learner) -> int:
    """One with the perceptual term, at the end of the training."""
    every = steps_at_once(learner)
    return learner.config.trainer.iterations // every * every


def per_step(time: Time, steps: int) -> Time:
    return Time(time.median / steps, time.p95 / steps, time.repeats)


def stages(learner: Learner, repeats: int) -> dict[str, Time]:
    """Of a step on a CPU, forward and backward."""
    avatar, stopwatch = learner.avatar, Stopwatch()
    watched = [(avatar, "draw", "splat"), (TrainingLoss, "loss", "loss"), (train_step, "check_step", "check")]
    watched.append((learner.state.optimizer, "step", "optimizer"))
    if isinstance(avatar, FlashAvatar):
        watched += [(avatar, "points", "embedding"), (avatar.deformation, "forward", "network")]
        watched += [] if avatar.grid is None else [(avatar, "interpolate", "interpolation")]
        watched += [] if avatar.hyper is None else [(avatar, "offsets", "heads")]
        watched.append((avatar, "apply_offsets", "apply_offsets"))
    with ExitStack() as stack:
        for owner, name, stage in watched:
            stack.enter_context(stopwatch.watching(owner, name, stage))
        for _ in range(repeats + 2):
            stopwatch.lap()
            learner.step(first_late_step(learner))
    return stopwatch.times()


def floors(avatar: Avatar) -> dict[str, float]:
    """Milliseconds in which this machine does the products, or moves the bytes, that a stage cannot do without.

    Network: a product for the outputs, one for the weights' gradients and, behind the first layer, one for the inputs'.
    Heads: parameters and latents read twice, their gradients written once, offsets and their gradients moved once.
    Optimizer: parameters, gradients and both moments read, all but the gradients written. Check: gradients read.
    """
    if not isinstance(avatar, FlashAvatar):
        return {}
    threads, places, network = torch.get_num_threads(), len(avatar.code), avatar.deformation
    first, *others = [layer.weight for layer in network.modules() if isinstance(layer, torch.nn.Linear)]
    code = first[:, : network.code_size].numel()
    products = 2 * code + 3 * sum(weight.numel() for weight in others)
    everything = sum(parameter.nbytes for parameter in avatar.parameters())
    found = {
        "network": roofline_ms(2.0 * places * products, 0.0, threads),
        "optimizer": roofline_ms(0.0, 7.0 * everything, threads),
        "check": roofline_ms(0.0, 1.0 * everything, threads),
    }
    if avatar.hyper is not None:
        own = sum(parameter.nbytes for parameter in avatar.hyper.parameters())
        moved = 3 * own + 4 * len(avatar) * (3 * avatar.config.latent_dim + 2 * 10)
        found["heads"] = roofline_ms(0.0, moved, threads)
    return found


def table(rows: Sequence[Row]) -> list[str]:
    """Milliseconds of a step as median (95th percentile), then of the stages of a step with the perceptual term."""
    lines = [
        f"{'recipe':>9} {'Gaussians':>9} {'network at':>10} {'parameters':>10} {'ms, first half':>17} "
        f"{'ms, second half':>17} {'faster':>7}"
    ]
    for row in rows:
        early, late = (f"{time.median:.1f} ({time.p95:.1f})" for time in (row.early, row.late))
        places, faster = f"{row.places:,}" if row.places else "-", rows[0].late.median / row.late.median
        lines.append(
            f"{row.recipe:>9} {row.gaussians:9,} {places:>10} {row.parameters:10,} {early:>17} {late:>17} {faster:6.1f}x"
        )
    # The row with most stages knows their order.
    names = [name for name in max((row.stages for row in rows), key=len) if not name.endswith(", backward")]
    if names:
        lines += ["", f"{'stage: forward / backward (floor)':>40} {''.join(f'{row.recipe:>24}' for row in rows)}"]
    for name in names:
        lines.append(f"{name:>40} {''.join(f'{stage_cell(row, name):>24}' for row in rows)}")
    return lines


def stage_cell(row: Row, name: str) -> str:
    times = [row.stages[part].median for part in (name, f"{name}, backward") if part in row.stages]
    floor = f" ({row.floors[name]:.1f})" if name in row.floors else ""
    return (" / ".join(f"{time:.2f}" for time in times) or "-") + floor
