"""The splatter's time and error: every variant is compared with the float64 reference first and timed after that.

Errors are against the reference with the usual cut-offs, also of variants that have others of their own: what they gain in
time is seen beside what they change in the image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from avatar.bench.clock import Time, paired_medians, synchronize
from avatar.bench.machine import available_simd, limited_to
from avatar.compute.device import CPU, interpreted
from avatar.errors import UserError
from avatar.splat import splat
from avatar.splat.scenes import HEAD_SPLATS, head_camera, head_shell
from avatar.types import Gaussians, Rendering

# What float32 and the cut-offs allow; tests/splat holds the kernel to the same.
IMAGE_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-4
ALPHA_MIN, T_MIN = 1 / 255, 1e-4  # the defaults of avatar.splat.splat
# Beside the defaults. A splat with an alpha of 1e-5 changes a channel by no more than the tolerance above; with 0 every
# splat would be drawn in every pixel.
OTHER_ALPHA_MINS, OTHER_T_MINS = (1e-5, 2 / 255, 4 / 255), (1e-6, 1e-2)
OWN_SIZE = 128  # pixels, at most, where a variant with its own cut-offs is compared with a reference that has the same


@dataclass(frozen=True)
class Variant:
    backend: Literal["cpu", "gpu", "reference"]
    count: int  # splats
    size: int  # pixels, width and height
    threads: int
    simd: str  # of the cpu backend; "" for the others
    alpha_min: float = ALPHA_MIN
    t_min: float = T_MIN

    @property
    def has_usual_cutoffs(self) -> bool:
        return (self.alpha_min, self.t_min) == (ALPHA_MIN, T_MIN)

    @property
    def changed(self) -> str:
        """What the variant has instead of the usual cut-offs."""
        parts = []
        if self.alpha_min != ALPHA_MIN:
            steps = 255 * self.alpha_min
            parts.append(f"alpha {steps:.0f}/255" if steps == round(steps) else f"alpha {self.alpha_min:.0e}")
        if self.t_min != T_MIN:
            parts.append(f"T {self.t_min:.0e}")
        return ", ".join(parts)


@dataclass(frozen=True)
class Accuracy:
    """Against the float64 reference with the usual cut-offs, at `size` x `size` pixels."""

    size: int
    image: float  # largest difference of a channel, at the pixels that are not ambiguous
    rms: float  # root of the mean squared difference of a channel, at the same pixels
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

    @property
    def total(self) -> float:
        """Milliseconds of both passes."""
        return self.timing.forward.median + self.timing.backward.median


class Truth(NamedTuple):
    """The reference's image of one scene, and its gradients for a cotangent that is zero at ambiguous pixels."""

    rendering: Rendering
    clear: Tensor  # bool [H, W], not ambiguous
    cotangent: Tensor  # [H, W, 3]
    gradients: tuple[Tensor, ...]


def all_variants(
    sizes: Sequence[int],
    counts: Sequence[int],
    *,
    count: int = HEAD_SPLATS,
    size: int = 512,
    all_threads: bool = False,
    on_gpu: bool = False,
) -> list[Variant]:
    """What is measured, by default with all threads and the best instruction set.

    Every size with `count` splats and every count at `size`, with one thread and with all; at (`count`, `size`) also the
    numbers of threads between (with `all_threads`), the other instruction sets, other cut-offs, and the float64 reference.
    With `on_gpu` every scene is drawn there too.
    """
    *others, best = available_simd()
    most = torch.get_num_threads()
    threads = sorted({1, most})
    scenes = dict.fromkeys([(count, s) for s in sizes] + [(n, size) for n in counts])
    variants = [Variant("cpu", n, s, t, best) for n, s in scenes for t in threads]
    if all_threads:
        variants += [Variant("cpu", count, size, t, best) for t in range(2, most)]
    variants += [Variant("cpu", count, size, t, simd) for simd in others for t in threads]
    variants += [Variant("cpu", count, size, most, best, alpha_min=value) for value in OTHER_ALPHA_MINS]
    variants += [Variant("cpu", count, size, most, best, t_min=value) for value in OTHER_T_MINS]
    variants += [Variant("gpu", n, s, most, "") for n, s in scenes if on_gpu]
    return [*variants, Variant("reference", count, size, most, "")]


def measure(
    variants: Sequence[Variant],
    *,
    repeats: int,
    validation_size: int,
) -> list[Row]:
    """Validate every variant at up to `validation_size` pixels, then time all of them.

    Variants of the same scene take turns, so that a disturbance of the machine meets all of them alike. Raises UserError
    for a variant whose image or gradients are wrong: the time of a wrong result says nothing.
    """
    rows: list[Row] = []
    for count, size in dict.fromkeys((v.count, v.size) for v in variants):
        group = [v for v in variants if (v.count, v.size) == (count, size)]
        gaussians, checked_size = head_shell(count), min(size, validation_size)
        print(f"{count:,} splats at {size}x{size}: comparing with the reference at {checked_size}x{checked_size}")
        truth = reference_of(gaussians, checked_size)
        accuracies = [None if v.backend == "reference" else validate(v, gaussians, checked_size, truth) for v in group]
        timings = time_in_turns(group, gaussians, size, repeats)
        rows += [Row(*row) for row in zip(group, accuracies, timings, strict=True)]
    return rows


def reference_of(gaussians: Gaussians, size: int, *, alpha_min: float = ALPHA_MIN, t_min: float = T_MIN) -> Truth:
    camera, black = head_camera(size), torch.zeros(3, dtype=torch.float64)
    leaves = Gaussians(*(t.double().requires_grad_() for t in gaussians))
    with torch.no_grad():
        # The cut-offs make jumps in the image, and float32 may rightly fall on either side of one.
        low, high = (
            splat(leaves, camera, black, backend="reference", alpha_min=f * alpha_min, t_min=f * t_min)
            for f in (1 - 1e-5, 1 + 1e-5)
        )
    clear = (low.image - high.image).abs().amax(-1) <= 1e-6
    noise = torch.randn(size, size, 3, generator=torch.Generator().manual_seed(1))
    cotangent = noise.masked_fill(~clear[..., None], 0.0)
    rendering = splat(leaves, camera, black, backend="reference", alpha_min=alpha_min, t_min=t_min)
    gradients = torch.autograd.grad(rendering.image, leaves, cotangent.double())
    return Truth(Rendering(*(t.detach() for t in rendering)), clear, cotangent, gradients)


def validate(variant: Variant, gaussians: Gaussians, size: int, truth: Truth) -> Accuracy:
    """The variant's errors at `size` pixels; UserError if they are above the tolerances.

    Where the variant has its own cut-offs, its errors against a reference with the same ones decide, at OWN_SIZE or less.
    """
    accuracy = accuracy_of(variant, gaussians, size, truth)
    found = accuracy
    if not variant.has_usual_cutoffs:
        size = min(size, OWN_SIZE)
        own = reference_of(gaussians, size, alpha_min=variant.alpha_min, t_min=variant.t_min)
        found = accuracy_of(variant, gaussians, size, own)
    if not (found.image <= IMAGE_TOLERANCE and found.gradient <= GRADIENT_TOLERANCE):  # not: a NaN is wrong too
        raise UserError(
            f"{variant} is wrong, so it is not timed: its image is off by {found.image:.1e} (at most "
            f"{IMAGE_TOLERANCE:.0e}) and its gradients by {found.gradient:.1e} of their length (at most "
            f"{GRADIENT_TOLERANCE:.0e})"
        )
    return accuracy


def accuracy_of(variant: Variant, gaussians: Gaussians, size: int, truth: Truth) -> Accuracy:
    leaves = leaves_of(variant, gaussians)
    found = draw(variant, leaves, size)
    gradients = torch.autograd.grad(found.image, leaves, truth.cotangent.to(found.image.device))
    difference = (found.image.detach().cpu() - truth.rendering.image)[truth.clear]
    gradient = max(float((a.cpu() - b).norm() / b.norm()) for a, b in zip(gradients, truth.gradients, strict=True))
    return Accuracy(
        size,
        float(difference.abs().max()),
        float(difference.square().mean().sqrt()),
        gradient,
        int((~truth.clear).sum()),
    )


def time_in_turns(variants: Sequence[Variant], gaussians: Gaussians, size: int, repeats: int) -> list[Timing]:
    """All variants in turns; the reference, seconds long, has three rounds of its own after them."""
    times: dict[tuple[Variant, str], Time] = {}
    for is_slow, rounds in ((False, repeats), (True, min(repeats, 3))):
        group = [v for v in variants if (v.backend == "reference") == is_slow]
        functions = {
            (variant, name): part for variant in group for name, part in passes_of(variant, gaussians, size).items()
        }
        times |= paired_medians(functions, rounds)
    return [Timing(times[variant, "forward"], times[variant, "backward"]) for variant in variants]


def passes_of(variant: Variant, gaussians: Gaussians, size: int) -> dict[str, Callable[[], object]]:
    """The forward pass, and the backward pass of the drawing that the forward pass made last."""
    device = device_of(variant.backend)
    leaves, cotangent = leaves_of(variant, gaussians), torch.ones(size, size, 3, device=device)
    drawn: list[Rendering] = []

    def forward() -> None:
        drawn[:] = [draw(variant, leaves, size)]
        synchronize(device)

    def backward() -> object:
        with limited_to(threads=variant.threads, simd=variant.simd):
            gradients = torch.autograd.grad(drawn.pop().image, leaves, cotangent)
            synchronize(device)
            return gradients

    return {"forward": forward, "backward": backward}


def device_of(backend: str) -> torch.device:
    """Where a backend draws."""
    return torch.device("cuda") if backend == "gpu" and not interpreted() else CPU


def leaves_of(variant: Variant, gaussians: Gaussians) -> Gaussians:
    """Copies to differentiate in, where the variant draws."""
    device = device_of(variant.backend)
    return Gaussians(*(t.detach().clone().to(device).requires_grad_() for t in gaussians))


def draw(variant: Variant, gaussians: Gaussians, size: int) -> Rendering:
    camera, black = head_camera(size), torch.zeros(3, device=gaussians.means.device)
    with limited_to(threads=variant.threads, simd=variant.simd):
        return splat(
            gaussians, camera, black, backend=variant.backend, alpha_min=variant.alpha_min, t_min=variant.t_min
        )
