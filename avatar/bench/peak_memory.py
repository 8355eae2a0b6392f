"""Peak memory of a drawing."""

from __future__ import annotations

import subprocess
import sys

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


def peak_memory(count: int, size: int) -> int:
    """Bytes that a forward and backward pass of the benchmark's scene takes beyond its inputs."""
    done = subprocess.run(
        [sys.executable, "-c", MEMORY_SCRIPT, str(count), str(size)], capture_output=True, text=True, check=True
    )
    return int(done.stdout)
