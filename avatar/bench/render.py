"""How long a trained avatar's frame takes, step by step and as a whole, and that the fast path draws the same picture.

Steps are timed inside of frames that one thread draws, as a stream's workers do; latency (one frame, all threads) and the
stream (several frames at a time) are timed as they are used. The frames are the run's held-out ones.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch

from avatar.bench import Request
from avatar.bench.clock import Time, paired_medians, synchronize
from avatar.bench.machine import limited_to
from avatar.bench.results import write_report
from avatar.bench.stages import Stopwatch
from avatar.compute.device import on_gpu, to_device
from avatar.errors import UserError
from avatar.model import FlashAvatar
from avatar.render import Renderer
from avatar.runs.run import open_trained
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera, HeadParams, Rendering

SIZES, QUICK_SIZES = (256, 512), (32,)
GAUSSIANS_TOLERANCE = 1e-4  # of a field's norm: float32 through a network of some layers
IMAGE_TOLERANCE = 1e-5  # mean over the pixels; single pixels may differ by 1/255 where a splat is at a cut-off

STEPS = {"embedding": "points", "heads": "offsets", "apply_offsets": "apply_offsets"}  # methods of the avatar
Input = tuple[HeadParams, Camera]


@dataclass(frozen=True)
class Error:
    """The renderer against `splat(avatar(params), camera, background)`, the worst of the frames."""

    gaussians: float  # largest of the fields' ||difference|| / ||field||
    image_mean: float  # mean absolute difference of a channel
    image_max: float


@dataclass(frozen=True)
class Row:
    size: int  # pixels, width
    error: Error
    steps: dict[str, Time]  # one thread
    frame: Time  # one thread: what a worker of a stream takes
    latency: Time  # all threads
    latency_of_avatar: Time  # all threads: splat(avatar(params), camera, background) without autograd
    stream_fps: float  # all threads; the median of the repeats


def run(request: Request) -> None:
    trained = open_trained(request.inputs[0], request.head)
    trained.avatar.to(torch.device(request.device))
    rows = measure(trained, QUICK_SIZES if request.quick else SIZES, repeats=3 if request.quick else 31)
    content = {"avatar": describe(trained), "rows": [asdict(row) for row in rows]}
    write_report(request.out, "bench_render", table(rows, describe(trained)), content)


def describe(trained: TrainedAvatar) -> dict[str, Any]:
    model = trained.config.model
    return {
        "subject": trained.name,
        "step": trained.step,
        "gaussians": len(trained.avatar),
        "model": model.name,
        "latent_dim": model.latent_dim,
        "latent_grid": model.latent_grid,
        "mlp_width": model.mlp_width,
    }


def measure(trained: TrainedAvatar, sizes: Sequence[int], *, repeats: int) -> list[Row]:
    """Compare, then time, where the avatar is. Raises UserError when the renderer draws another picture: its time would
    say nothing."""
    renderer = Renderer(trained.avatar, torch.tensor(trained.config.data.background))
    device = renderer.background.device
    rows = []
    for size in sizes:
        frames = inputs(trained, size, count=repeats)
        error = compare(trained, renderer, frames[:5])
        with torch.no_grad():
            render = next_of([partial(synchronized, device, renderer.render, *frame) for frame in frames])
            unfolded = next_of([partial(synchronized, device, draw_unfolded, trained, *frame) for frame in frames])
            with limited_to(threads=1):
                steps = {} if on_gpu(renderer.background) else time_steps(renderer, frames)
                (frame,) = paired_medians({"frame": render}, repeats, warm_up=3).values()
            latency = paired_medians({"renderer": render, "avatar": unfolded}, repeats, warm_up=3)
        rates = [stream_rate(renderer, frames) for _ in range(3)]
        rows.append(Row(size, error, steps, frame, latency["renderer"], latency["avatar"], statistics.median(rates)))
    return rows


def inputs(trained: TrainedAvatar, size: int, count: int) -> list[Input]:
    """Held-out frames, spread evenly over the test part, seen `size` pixels wide."""
    recording, test = trained.recording, trained.recording.split.test
    chosen = [test[i * len(test) // count] for i in range(count)]
    return [(recording.params(i), recording.camera(i, size)) for i in chosen]


@torch.no_grad()
def compare(trained: TrainedAvatar, renderer: Renderer, frames: Sequence[Input]) -> Error:
    """Raises UserError, with the figures, above the tolerances."""
    gaussians = mean = largest = 0.0
    for params, camera in frames:
        truth, found = trained.avatar(params, None, camera.head_rotation), renderer.gaussians(params, camera)
        gaussians = max(gaussians, *(float((a - b).norm() / b.norm()) for a, b in zip(found, truth, strict=True)))
        difference = (renderer.render(params, camera).image - draw_unfolded(trained, params, camera).image).abs()
        mean, largest = max(mean, float(difference.mean())), max(largest, float(difference.max()))
    if not (gaussians <= GAUSSIANS_TOLERANCE and mean <= IMAGE_TOLERANCE):  # not: a NaN is wrong too
        raise UserError(
            f"the renderer is wrong, so it is not timed: its Gaussians are off by {gaussians:.1e} of their size (at most "
            f"{GAUSSIANS_TOLERANCE:.0e}) and its image by {mean:.1e} on average (at most {IMAGE_TOLERANCE:.0e})"
        )
    return Error(gaussians, mean, largest)


def time_steps(renderer: Renderer, frames: Sequence[Input]) -> dict[str, Time]:
    """What each step takes of a frame on a CPU; a GPU makes one launch or two of all of them."""
    avatar, stopwatch = renderer.avatar, Stopwatch()
    watched = [(avatar, "vertices", "skinning"), (avatar, "draw", "splat")]
    if isinstance(avatar, FlashAvatar):
        watched += [(avatar.deformation, "forward", "network"), (avatar, "interpolate", "network")]
        watched += [(avatar, name, step) for step, name in STEPS.items()]
    with ExitStack() as stack:
        for owner, name, step in watched:
            stack.enter_context(stopwatch.watching(owner, name, step))
        for frame in (*frames[:2], *frames):
            stopwatch.lap()
            renderer.render(*frame)
    return stopwatch.times()


def draw_unfolded(trained: TrainedAvatar, params: HeadParams, camera: Camera) -> Rendering:
    background = to_device(torch.tensor(trained.config.data.background), trained.avatar.device)
    return trained.avatar.draw(trained.avatar(params, None, camera.head_rotation), camera, background)


def synchronized(device: torch.device, function: Callable[..., object], *arguments: object) -> None:
    """Call it, and wait until a GPU is done with it."""
    function(*arguments)
    synchronize(device)


def next_of(calls: Sequence[Callable[[], object]]) -> Callable[[], object]:
    """A function that makes one call after the other, round and round."""
    turn = itertools.cycle(calls)
    return lambda: next(turn)()


def stream_rate(renderer: Renderer, frames: Sequence[Input]) -> float:
    """Frames per second of a stream, its start and end included."""
    many = list(itertools.islice(itertools.cycle(frames), max(4 * len(frames), 100)))
    begin = time.perf_counter()
    count = sum(1 for _ in renderer.stream(many))
    return count / (time.perf_counter() - begin)


def table(rows: Sequence[Row], avatar: dict[str, Any]) -> list[str]:
    threads = torch.get_num_threads()
    grid = f", latents on {avatar['latent_grid']}x{avatar['latent_grid']} cells" if avatar["latent_grid"] else ""
    lines: dict[str, list[str]] = {"image width": [f"{row.size} px" for row in rows]}
    lines |= {f"{step}, 1 thread": [str(row.steps[step]) for row in rows] for step in rows[0].steps}
    lines |= {
        "whole frame, 1 thread": [str(row.frame) for row in rows],
        f"whole frame, {threads} threads": [str(row.latency) for row in rows],
        "   the same unfolded": [str(row.latency_of_avatar) for row in rows],
        f"stream, {threads} frames at a time": [f"{row.stream_fps:.0f} fps" for row in rows],
        "image error, mean": [f"{row.error.image_mean:.1e}" for row in rows],
        "image error, largest": [f"{row.error.image_max:.1e}" for row in rows],
    }
    return [
        f"{avatar['subject']}, step {avatar['step']}: {avatar['gaussians']:,} Gaussians ({avatar['model']}{grid}, "
        f"network {avatar['mlp_width']} wide)",
        "Milliseconds, median (95th percentile). Unfolded: the avatar itself, without autograd; errors are against it.",
        *(f"{name:>30} " + " ".join(f"{cell:>16}" for cell in cells) for name, cells in lines.items()),
    ]
