"""The splatter's time and error: every variant is compared with the float64 reference first and timed after that."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

import avatar
from avatar.bench.scenes import HEAD_SPLATS, head_camera, head_shell
from avatar.errors import UserError
from avatar.splat import splat
from avatar.types import Gaussians, Rendering

SIMD = ("baseline", "avx2", "avx512")
# What float32 and the cut-offs allow; tests/splat holds the kernel to the same.
IMAGE_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-4
ALPHA_MIN, T_MIN = 1 / 255, 1e-4  # the defaults of avatar.splat.splat


@dataclass(frozen=True)
class Variant:
    backend: Literal["cpu", "reference"]
    count: int  # splats
    size: int  # pixels, width and height
    threads: int
    simd: str  # of the cpu backend; "" for the reference


@dataclass(frozen=True)
class Accuracy:
    """Against the float64 reference, at `size` x `size` pixels."""

    size: int
    image: float  # largest difference of a channel, at the pixels that are not ambiguous
    gradient: float  # largest of the five tensors' ||difference|| / ||reference||
    ambiguous: int  # pixels where float64 itself sits on a cut-off to 1e-5; left out of both


@dataclass(frozen=True)
class Timing:
    """Milliseconds through the public function."""

    forward: float  # median
    forward_p95: float
    backward: float  # median
    backward_p95: float
    repeats: int


@dataclass(frozen=True)
class Row:
    variant: Variant
    accuracy: Accuracy | None  # None: the reference itself
    timing: Timing


class Truth(NamedTuple):
    """The reference's image of one scene, and its gradients for a cotangent that is zero at ambiguous pixels."""

    rendering: Rendering
    clear: Tensor  # bool [H, W], not ambiguous
    cotangent: Tensor  # [H, W, 3]
    gradients: tuple[Tensor, ...]


Draw = Callable[..., Rendering]


def available_simd() -> list[str]:
    """The instruction sets that this build and this processor have, slowest first."""
    found = []
    for name in SIMD:
        try:
            draw(Variant("cpu", 1, 8, 1, name), head_shell(1), 8)
        except ValueError:
            continue
        found.append(name)
    return found


def all_variants(
    sizes: Sequence[int] = (128, 256, 512, 1024),
    counts: Sequence[int] = (1_000, 5_000, HEAD_SPLATS, 50_000, 200_000),
    *,
    count: int = HEAD_SPLATS,
    size: int = 512,
) -> list[Variant]:
    """Every size with `count` splats and every count at `size`, with one thread and with all, with the best instruction
    set; the other sets and the plain-torch reference once each at (`count`, `size`)."""
    *others, best = available_simd()
    threads = sorted({1, torch.get_num_threads()})
    scenes = dict.fromkeys([(count, s) for s in sizes] + [(n, size) for n in counts])
    variants = [Variant("cpu", n, s, t, best) for n, s in scenes for t in threads]
    variants += [Variant("cpu", count, size, t, simd) for simd in others for t in threads]
    return [*variants, Variant("reference", count, size, threads[-1], "")]


def measure(
    variants: Sequence[Variant],
    *,
    repeats: int,
    validation_size: int,
    say: Callable[[str], None] = print,
    function: Draw = splat,
) -> list[Row]:
    """Validate every variant at up to `validation_size` pixels, then time all of them.

    Variants of the same scene take turns, so that a disturbance of the machine meets all of them alike. Raises UserError
    for a variant whose image or gradients are wrong: the time of a wrong result says nothing.
    """
    rows: list[Row] = []
    for count, size in dict.fromkeys((v.count, v.size) for v in variants):
        group = [v for v in variants if (v.count, v.size) == (count, size)]
        gaussians, checked_size = head_shell(count), min(size, validation_size)
        say(f"{count:,} splats at {size}x{size}: comparing with the reference at {checked_size}x{checked_size}")
        truth = reference_of(gaussians, checked_size)
        accuracies = [
            validate(v, gaussians, checked_size, truth, function) if v.backend == "cpu" else None for v in group
        ]
        timings = time_in_turns(group, gaussians, size, repeats, function)
        rows += [Row(*row) for row in zip(group, accuracies, timings, strict=True)]
    return rows


def reference_of(gaussians: Gaussians, size: int) -> Truth:
    camera, black = head_camera(size), torch.zeros(3, dtype=torch.float64)
    leaves = Gaussians(*(t.double().requires_grad_() for t in gaussians))
    with torch.no_grad():
        # The cut-offs make jumps in the image, and float32 may rightly fall on either side of one.
        low, high = (
            splat(leaves, camera, black, backend="reference", alpha_min=f * ALPHA_MIN, t_min=f * T_MIN)
            for f in (1 - 1e-5, 1 + 1e-5)
        )
    clear = (low.image - high.image).abs().amax(-1) <= 1e-6
    noise = torch.randn(size, size, 3, generator=torch.Generator().manual_seed(1))
    cotangent = noise.masked_fill(~clear[..., None], 0.0)
    rendering = splat(leaves, camera, black, backend="reference")
    gradients = torch.autograd.grad(rendering.image, leaves, cotangent.double())
    return Truth(Rendering(*(t.detach() for t in rendering)), clear, cotangent, gradients)


def validate(variant: Variant, gaussians: Gaussians, size: int, truth: Truth, function: Draw = splat) -> Accuracy:
    """The variant's errors at `size` pixels; UserError if they are above the tolerances."""
    leaves = Gaussians(*(t.clone().requires_grad_() for t in gaussians))
    found = draw(variant, leaves, size, function)
    gradients = torch.autograd.grad(found.image, leaves, truth.cotangent)
    image = float((found.image.detach() - truth.rendering.image)[truth.clear].abs().max())
    gradient = max(float((a - b).norm() / b.norm()) for a, b in zip(gradients, truth.gradients, strict=True))
    if not (image <= IMAGE_TOLERANCE and gradient <= GRADIENT_TOLERANCE):  # not: a NaN is wrong too
        raise UserError(
            f"{variant} is wrong, so it is not timed: its image is off by {image:.1e} (at most {IMAGE_TOLERANCE:.0e}) "
            f"and its gradients by {gradient:.1e} of their length (at most {GRADIENT_TOLERANCE:.0e})"
        )
    return Accuracy(size, image, gradient, int((~truth.clear).sum()))


def time_in_turns(
    variants: Sequence[Variant], gaussians: Gaussians, size: int, repeats: int, function: Draw = splat
) -> list[Timing]:
    """One unmeasured round, then `repeats` rounds; the reference, seconds long, has three of its own after them."""
    times: dict[Variant, list[tuple[float, float]]] = {variant: [] for variant in variants}
    fast = [v for v in variants if v.backend == "cpu"]
    slow = [v for v in variants if v.backend == "reference"]
    for group, rounds in ((fast, repeats), (slow, min(repeats, 3))):
        for turn in range(-1, rounds):
            for variant in group:
                measured = time_once(variant, gaussians, size, function)
                if turn >= 0:
                    times[variant].append(measured)
    return [timing_of(times[variant]) for variant in variants]


def time_once(variant: Variant, gaussians: Gaussians, size: int, function: Draw = splat) -> tuple[float, float]:
    """Milliseconds of one forward and of one backward pass."""
    leaves, cotangent = Gaussians(*(t.clone().requires_grad_() for t in gaussians)), torch.ones(size, size, 3)
    with threads_of(variant):
        begin = time.perf_counter()
        rendering = draw(variant, leaves, size, function)
        middle = time.perf_counter()
        torch.autograd.grad(rendering.image, leaves, cotangent)
        end = time.perf_counter()
    return 1e3 * (middle - begin), 1e3 * (end - middle)


def timing_of(times: Sequence[tuple[float, float]]) -> Timing:
    forward, backward = (sorted(column) for column in zip(*times, strict=True))
    p95 = round(0.95 * (len(times) - 1))
    return Timing(statistics.median(forward), forward[p95], statistics.median(backward), backward[p95], len(times))


def draw(variant: Variant, gaussians: Gaussians, size: int, function: Draw = splat) -> Rendering:
    with threads_of(variant):
        return function(gaussians, head_camera(size), torch.zeros(3), backend=variant.backend)


@contextmanager
def threads_of(variant: Variant) -> Iterator[None]:
    """Let torch and the kernel work as `variant` says, and as before afterwards."""
    names, threads = ("AVATAR_THREADS", "AVATAR_SIMD"), torch.get_num_threads()
    before = {name: os.environ.get(name) for name in names}
    torch.set_num_threads(variant.threads)
    os.environ.update(AVATAR_THREADS=str(variant.threads), AVATAR_SIMD=variant.simd)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def as_json(rows: Sequence[Row]) -> dict[str, Any]:
    """All figures, with the machine that they belong to; milliseconds."""
    machine = {
        "avatar": avatar.__version__,
        "torch": torch.__version__,
        "system": f"{platform.system()} {platform.machine()}",
        "processors": os.cpu_count(),
        "simd": available_simd(),
    }
    return {"machine": machine, "rows": [asdict(row) for row in rows]}
