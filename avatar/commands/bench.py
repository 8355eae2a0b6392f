"""avatar bench: time and error of a part on this machine."""

from __future__ import annotations

from argparse import Namespace
from importlib import import_module
from pathlib import Path

import torch

from avatar.bench import PARTS, Request
from avatar.commands.outputs import check_folder_output
from avatar.compute.device import CPU
from avatar.config_values import check_device
from avatar.errors import UserError, check_installed
from avatar.pipeline import OK
from avatar.pipeline.choose_device import choose_device


def run_bench(arguments: Namespace) -> int:
    check_installed("a benchmark's plot", "plots", "matplotlib")
    out: Path = arguments.out
    device = bench_device(arguments.part, arguments.device)
    check_folder_output(out, [*arguments.inputs, arguments.head, arguments.tracking])
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be made ({error.strerror}); choose another --out") from error
    request = Request(
        out,
        arguments.quick,
        arguments.full,
        tuple(arguments.inputs),
        tuple(arguments.overrides),
        arguments.head,
        arguments.tracking,
        arguments.frame_offset,
        str(device),
    )
    # Only the part that is asked for is imported.
    import_module(PARTS[arguments.part].module).run(request)
    return OK


def bench_device(part: str, name: str | None) -> torch.device:
    """Where a part is measured. Raises UserError for a GPU that is asked for where only the CPU is measured."""
    if PARTS[part].on_gpu:
        return choose_device(name or "auto", print)
    check_device(name or "auto")
    if name not in (None, "auto", "cpu"):
        measured = ", ".join(each for each in PARTS if PARTS[each].on_gpu)
        raise UserError(
            f"bench {part} measures the CPU only; on a GPU {measured} are measured, and the parts of a step by "
            "scripts/measure_gpu.py"
        )
    return CPU
