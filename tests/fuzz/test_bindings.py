"""Whatever the compiled functions are called with, they answer or raise TypeError or ValueError.

A thousand calls, or a fiftieth of AVATAR_STRESS_EXAMPLES if that is more.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from avatar import _core

pytestmark = pytest.mark.slow

EXAMPLES = max(1000, int(os.environ.get("AVATAR_STRESS_EXAMPLES", "0")) // 50)


def test_no_arguments_crash_a_compiled_function(tmp_path: Path) -> None:
    # In a process of its own, so that a crash is a failure of this test; `scripts/sanitize.sh` runs Python with -S.
    last = tmp_path / "last call"
    flags = ["-S"] if sys.flags.no_site else []
    script = Path(__file__).with_name("call_bindings.py")
    command = [sys.executable, *flags, "-X", "faulthandler", str(script), str(EXAMPLES), str(last)]
    done = subprocess.run(command, capture_output=True, text=True)
    call = last.read_text() if last.exists() else "none"
    assert done.returncode == 0, f"status {done.returncode} after the call {call}:\n{done.stderr[-4000:]}"
    found = re.fullmatch(r"(\d+) answered, (\d+) refused\n", done.stdout)
    assert found is not None and all(int(count) > EXAMPLES / 10 for count in found.groups()), done.stdout


def test_the_message_names_argument_expectation_and_what_was_given() -> None:
    def interpolate(**other: torch.Tensor) -> None:
        arrays = {"grid": (9, 5), "weights": (7, 4), "out": (7, 5)}
        call = {name: torch.zeros(shape) for name, shape in arrays.items()}
        call |= {"cells": torch.zeros(7, 4, dtype=torch.int32)}
        _core.interpolate_forward(**{**call, **other}, simd="", threads=1)

    interpolate()
    with pytest.raises(ValueError, match=r"^weights must have shape \[N, 4\], got \[7, 3\]$"):
        interpolate(weights=torch.zeros(7, 3))
    with pytest.raises(ValueError, match=r"^grid must have shape \[G, n\], got \[45\]$"):
        interpolate(grid=torch.zeros(45))
    with pytest.raises(ValueError, match=r"^out has N = 8, but cells has N = 7; they must be the same$"):
        interpolate(out=torch.zeros(8, 5))
    with pytest.raises(ValueError, match=r"^grid has G = 4294967296, but must have less than 2\^31$"):
        interpolate(grid=torch.zeros(2**32, 0))


@pytest.mark.parametrize("wrong", [-1, 9, 2**31 - 1, -(2**31)])
def test_an_index_that_is_not_there_is_refused(wrong: int) -> None:
    # It was read and written through, which ended the process.
    cells, places = torch.zeros(7, 4, dtype=torch.int32), torch.arange(28, dtype=torch.int32) // 4
    grid, weights, values = torch.ones(9, 5), torch.ones(7, 4), torch.empty(7, 5)
    cells[6, 2] = wrong
    message = rf"^cells has the index {wrong} as value 26, but there are 9 rows$"
    with pytest.raises(ValueError, match=message):
        _core.interpolate_forward(grid, cells, weights, "", 1, values)

    begins = torch.tensor([0, *[28] * 9])
    places[26] = wrong
    with pytest.raises(ValueError, match=rf"^gaussians has the index {wrong} as value 26, but there are 7 rows$"):
        _core.interpolate_backward(values, begins, places, weights.reshape(-1), "", 1, grid)

    screen, faces = torch.rand(9, 3), torch.tensor([[0, 1, 2], [3, wrong, 4]], dtype=torch.int32)
    raster = torch.empty(4, 4, dtype=torch.int32), torch.empty(4, 4, 3), torch.empty(4, 4)
    with pytest.raises(ValueError, match=rf"^faces has the index {wrong} as value 4, but there are 9 rows$"):
        _core.rasterize_mesh(screen, faces, *raster)


@pytest.mark.parametrize("begins", [[0, 3, 2, 4], [-1, 0, 0, 4], [0, 5, 5, 4], [0, 0, 0, 3]])
def test_parts_that_overlap_or_reach_beyond_the_end_are_refused(begins: list[int]) -> None:
    grad, places, weights = torch.ones(1, 2), torch.zeros(4, dtype=torch.int32), torch.ones(4)
    with pytest.raises(ValueError, match="begins must|last value of begins must"):
        _core.interpolate_backward(grad, torch.tensor(begins), places, weights, "", 1, torch.empty(3, 2))


def test_a_tensor_that_no_memory_could_hold_is_refused() -> None:
    for shape in ([2**40, 2**40], [2**62, 4], [2**45]):
        with pytest.raises(ValueError, match="^a tensor of this shape would need more than 64 TiB of memory$"):
            _core.large_tensor(shape)


def test_impossible_numbers_of_threads_are_refused() -> None:
    # Rows of windows are divided among threads: none would be a division by zero.
    image, mask = torch.zeros(11, 11, 3), torch.ones(11, 11)
    for threads in (0, -2, 1025):
        with pytest.raises(ValueError, match=f"^threads must be 1 to 1024, got {threads}$"):
            _core.dssim(image, image, mask, "", threads, None)
