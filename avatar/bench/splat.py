"""The splatter's time and error: every variant is compared with the float64 reference first and timed after that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from avatar.bench.clock import Time, paired_medians
from avatar.bench.machine import available_simd, describe_machine, limited_to
from avatar.bench.scenes import HEAD_SPLATS, head_camera, head_shell
from avatar.bench.splat_work import Work
from avatar.errors import UserError
from avatar.splat import splat
from avatar.types import Gaussians, Rendering

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
    """Through the public function, with autograd."""

    forward: Time
    backward: Time


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


def all_variants(
    sizes: Sequence[int], counts: Sequence[int], *, count: int = HEAD_SPLATS, size: int = 512
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
    """All variants in turns; the reference, seconds long, has three rounds of its own after them."""
    fast = [v for v in variants if v.backend == "cpu"]
    slow = [v for v in variants if v.backend == "reference"]
    times: dict[tuple[Variant, str], Time] = {}
    for group, rounds in ((fast, repeats), (slow, min(repeats, 3))):
        functions = {
            (variant, name): part
            for variant in group
            for name, part in passes_of(variant, gaussians, size, function).items()
        }
        times |= paired_medians(functions, rounds)
    return [Timing(times[variant, "forward"], times[variant, "backward"]) for variant in variants]


def passes_of(
    variant: Variant, gaussians: Gaussians, size: int, function: Draw = splat
) -> dict[str, Callable[[], object]]:
    """The forward pass, and the backward pass of the drawing that the forward pass made last."""
    leaves, cotangent = Gaussians(*(t.clone().requires_grad_() for t in gaussians)), torch.ones(size, size, 3)
    drawn: list[Rendering] = []

    def forward() -> None:
        drawn[:] = [draw(variant, leaves, size, function)]

    def backward() -> object:
        with limited_to(threads=variant.threads, simd=variant.simd):
            return torch.autograd.grad(drawn.pop().image, leaves, cotangent)

    return {"forward": forward, "backward": backward}


def draw(variant: Variant, gaussians: Gaussians, size: int, function: Draw = splat) -> Rendering:
    with limited_to(threads=variant.threads, simd=variant.simd):
        return function(gaussians, head_camera(size), torch.zeros(3), backend=variant.backend)


def as_json(rows: Sequence[Row], works: Sequence[Work]) -> dict[str, Any]:
    """All figures, with the machine that they belong to; milliseconds and bytes."""
    return {
        "machine": describe_machine(),
        "rows": [asdict(row) for row in rows],
        "work": [asdict(work) for work in works],
    }
