"""What a drawing has to do: arithmetic, memory traffic and peak memory, beside the times that it takes."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass

import torch

from avatar.bench.floor import floor_ms
from avatar.splat import Counters, counters
from avatar.splat.scenes import head_camera, head_shell

# Floating-point operations of the kernels for one splat at one pixel, an fma as two (csrc/splat/raster_forward.h and
# raster_backward.h): distances 2, falloff 17, then alpha, transmittance and colour, or their gradients and nine sums.
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 32, 54
FLOATS_PER_SPLAT = 3 + 4 + 3 + 1 + 48  # of the five inputs with colours of degree 3
# What the kernels keep of a pair, a projected splat, a pair's gradient.
PAIR_BYTES, SPLAT_BYTES, MOMENT_BYTES = 8, 64, 36
PIXEL_BYTES = 16  # image and alpha

# Peak memory is measured in a process of its own, by Linux's high-water mark, set back before the drawing.
MEMORY_SCRIPT = """
import sys, torch
from pathlib import Path
from avatar.splat.scenes import head_camera, head_shell
from avatar.splat import splat
from avatar.types import Gaussians
def high_water():
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])
def draw(count, size):
    leaves = Gaussians(*(t.requires_grad_() for t in head_shell(count)))
    Path("/proc/self/clear_refs").write_text("5")
    before = high_water()
    image = splat(leaves, head_camera(size), torch.zeros(3)).image
    torch.autograd.grad(image, leaves, torch.ones_like(image))
    return high_water() - before
draw(100, 32)
print(draw(int(sys.argv[1]), int(sys.argv[2])))
"""


@dataclass(frozen=True)
class Work:
    """Of one scene, whatever the instruction set and the number of threads."""

    count: int
    size: int
    counters: dict[str, int]  # avatar.splat.Counters
    forward: tuple[int, int]  # operations, bytes
    backward: tuple[int, int]
    memory: int | None  # bytes of a forward and backward pass beyond the inputs; None: not measured


def work_of(count: int, size: int, *, with_memory: bool = True) -> Work:
    found = counters(head_shell(count), head_camera(size), torch.zeros(3))
    forward, backward = operations_and_bytes(found, count, size)
    memory = peak_memory(count, size) if with_memory and sys.platform == "linux" else None
    return Work(count, size, found._asdict(), forward, backward, memory)


def operations_and_bytes(found: Counters, count: int, size: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Of the forward and of the backward pass; every byte that has to be read or written once counts once."""
    inputs, pixels = 4 * FLOATS_PER_SPLAT * count, PIXEL_BYTES * size * size
    lists = PAIR_BYTES * found.pairs + SPLAT_BYTES * found.visible
    return (
        (FORWARD_OPERATIONS * found.pixels_evaluated, inputs + pixels + 2 * lists),
        (
            BACKWARD_OPERATIONS * found.pixels_evaluated,
            2 * inputs + 2 * pixels + lists + 2 * MOMENT_BYTES * found.pairs,
        ),
    )


def peak_memory(count: int, size: int) -> int:
    done = subprocess.run(
        [sys.executable, "-c", MEMORY_SCRIPT, str(count), str(size)], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


def floors(work: Work, threads: int) -> tuple[float, float]:
    """Milliseconds of the forward and the backward pass, estimated by `avatar.bench.floor` from this kernel's counts."""
    return floor_ms(*work.forward, threads), floor_ms(*work.backward, threads)
