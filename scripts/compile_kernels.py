"""Compile every GPU kernel ahead of time, for targets that this machine need not have, and say what each one takes.

    python scripts/compile_kernels.py [--out docs/bench/gpu_kernels.md] [--targets sm_90 gfx942 ...] [--jobs 2]

What is compiled is what the program starts: drawings, training steps and frames are rehearsed on torch's meta device,
where a start is noted and nothing computed. Ends with status 1 when a kernel does not compile, or keeps values in memory
because the registers do not suffice.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
import triton
from count_launches import META, Rehearsal
from torch import Tensor
from triton.backends import nvidia
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from avatar.demo.head import demo_head
from avatar.demo.scene import head_assets
from avatar.head.assets import HeadAssets
from avatar.kernels.launch import watched
from avatar.losses.photometric import dssim
from avatar.splat import splat, splat_features
from avatar.splat.scenes import head_camera, head_shell
from avatar.train.loss import PerceptualTerm, Weighted
from avatar.types import Gaussians

TARGETS = {
    "sm_80": GPUTarget("cuda", 80, 32),
    "sm_90": GPUTarget("cuda", 90, 32),
    "sm_100": GPUTarget("cuda", 100, 32),
    "sm_120": GPUTarget("cuda", 120, 32),
    "gfx942": GPUTarget("hip", "gfx942", 64),
    "gfx1100": GPUTarget("hip", "gfx1100", 32),
}
TYPES = {
    torch.float32: "*fp32",
    torch.float64: "*fp64",
    torch.int64: "*i64",
    torch.int32: "*i32",
    torch.int16: "*i16",
    torch.int8: "*i8",
    torch.uint8: "*u8",
}
DIVISIBLE = [["tt.divisibility", 16]]
SHOWN = ("ANTIALIASED", "POSE", "HAS_IMAGE", "HAS_ALPHA", "HAS_GRID", "HAS_HYPER", "SAVE", "GRADIENT", "COLUMNS")
SHOWN += ("WIDTH", "STORED", "FEATURES", "GROUP", "channels")


class Variant(NamedTuple):
    """One kernel as Triton would compile it for a start: what it knows of the arguments, and the constants."""

    module: str
    kernel: str
    signature: tuple[tuple[str, str], ...]
    divisible: tuple[int, ...]  # arguments that are known to be multiples of 16
    constants: tuple[tuple[str, Any], ...]
    warps: int

    @property
    def label(self) -> str:
        chosen = [f"{name}={value}" for name, value in self.constants if name in SHOWN]
        chosen += [f"{name}=16n" for name in (self.signature[i][0] for i in self.divisible) if name in SHOWN]
        return f"{self.kernel} ({', '.join(chosen)})" if chosen else self.kernel


class Use(NamedTuple):
    """Of one variant on one target."""

    registers: int
    spilled: int  # bytes a thread on NVIDIA's, registers on AMD's
    shared: int  # bytes a program


def variant_of(kernel: Any, arguments: Sequence[Any], constants: dict[str, Any]) -> Variant:
    """As Triton specialises: by type, and unless the kernel says otherwise by divisibility and for 1."""
    names = kernel.arg_names
    fixed = {kernel.arg_names[i] if isinstance(i, int) else i for i in kernel.do_not_specialize or ()}
    signature, divisible, ones = [], [], []
    for i, name in enumerate(names):
        if i >= len(arguments):
            signature.append((name, "constexpr"))
        elif isinstance(arguments[i], Tensor):
            signature.append((name, TYPES[arguments[i].dtype]))
            divisible.append(i)  # torch's allocations are
        elif isinstance(arguments[i], int) and arguments[i] == 1 and name not in fixed:
            signature.append((name, "constexpr"))
            ones.append((name, 1))
        elif isinstance(arguments[i], int):
            signature.append((name, "i32"))
            if name not in fixed and arguments[i] % 16 == 0:
                divisible.append(i)
        else:
            signature.append((name, "fp32"))
    warps = constants.pop("num_warps")
    own = (*ones, *((name, constants[name]) for name in names[len(arguments) :]))
    return Variant(kernel.fn.__module__, kernel.fn.__name__, tuple(signature), tuple(divisible), own, warps)


def rehearse(assets: HeadAssets) -> list[Variant]:
    """Every variant that drawing, training and rendering start."""
    found: dict[Variant, None] = {}

    def note(kernel: Any, _: Any, arguments: Sequence[Any], constants: dict[str, Any]) -> None:
        found[variant_of(kernel, arguments, dict(constants))] = None

    term = PerceptualTerm("dssim", Weighted(dssim, 0.05))
    with watched(note):
        for overrides in ((), ("experiment=paper",), ("model=flashavatar",)):
            rehearsal = Rehearsal(assets, 128, 512, overrides)
            rehearsal.step(term, late=True)
            rehearsal.rendered()
        still = head_camera(512)
        R, t = (part.to(META).requires_grad_() for part in (still.R_cam_world, still.t_cam_world))
        for antialiased, camera in product((False, True), (still, replace(still, R_cam_world=R, t_cam_world=t))):
            shell = Gaussians(*(field.to(META).requires_grad_() for field in head_shell()))
            drawn = splat(shell, camera, torch.zeros(3, device=META), antialiased=antialiased)
            (drawn.image.sum() + drawn.alpha.sum()).backward()
        # 1, multiples of 16 and others, in groups of either size; the image alone, and with alpha.
        for channels, outputs in product((1, 8, 16, 32, 33), (1, 2)):
            features = torch.zeros(len(shell.means), channels, device=META, requires_grad=True)
            drawn = splat_features(*shell[:4], features, still, torch.zeros(channels, device=META))
            torch.stack([output.sum() for output in drawn[:outputs]]).sum().backward()
    return sorted(found)


def compile_one(task: tuple[Variant, str]) -> Use | str:
    """What it takes, or why it does not compile."""
    variant, target = task
    module = __import__(variant.module, fromlist=[variant.kernel])
    kernel, names = getattr(module, variant.kernel), [name for name, _ in variant.signature]
    source = ASTSource(
        kernel,
        dict(variant.signature),
        constexprs={(names.index(name),): value for name, value in variant.constants},
        attrs={(i,): DIVISIBLE for i in variant.divisible},
    )
    options = {"num_warps": variant.warps, "num_stages": 1, "enable_fp_fusion": False}
    try:
        compiled = triton.compile(source, target=TARGETS[target], options=options)
    except Exception as error:  # a compiler may fail in any way
        return f"{type(error).__name__}: {error}"
    return use_on_nvidia(compiled.asm["cubin"]) if "cubin" in compiled.asm else use_on_amd(compiled.asm["amdgcn"])


def use_on_nvidia(cubin: bytes) -> Use:
    tool = Path(nvidia.__file__).parent / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        text = subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True, check=True).stdout
    found = re.search(r"REG:(\d+) STACK:(\d+) SHARED:(\d+) LOCAL:(\d+)", text)
    assert found is not None, text
    registers, stack, shared, local = map(int, found.groups())
    return Use(registers, stack + local, shared)


def use_on_amd(assembly: str) -> Use:
    def value(name: str) -> int:
        found = re.search(rf"\.{name}:\s+(\d+)", assembly)
        assert found is not None, name
        return int(found[1])

    spilled = value("vgpr_spill_count") + value("sgpr_spill_count")
    return Use(value("vgpr_count"), spilled, value("group_segment_fixed_size"))


def table(variants: Sequence[Variant], targets: Sequence[str], uses: dict[tuple[Variant, str], Use]) -> str:
    lines = [
        "# What the GPU's kernels take",
        "",
        f"Registers a thread, by Triton {triton.__version__}'s compilers; `python scripts/compile_kernels.py` writes this. "
        "No kernel spills one.",
        "",
        "| kernel | warps | shared bytes | " + " | ".join(targets) + " |",
        "|---|---|---|" + "---|" * len(targets),
    ]
    for variant in variants:
        shared = max(uses[variant, target].shared for target in targets)
        cells = [str(uses[variant, target].registers) for target in targets]
        lines.append(f"| `{variant.label}` | {variant.warps} | {shared} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="write the table there")
    parser.add_argument("--targets", nargs="+", choices=tuple(TARGETS), default=list(TARGETS))
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    variants = rehearse(head_assets(demo_head()))
    tasks = [(variant, target) for variant in variants for target in arguments.targets]
    with ProcessPoolExecutor(arguments.jobs) as pool:
        found = dict(zip(tasks, pool.map(compile_one, tasks), strict=True))
    failed = {task: use for task, use in found.items() if isinstance(use, str) or use.spilled}
    for (variant, target), use in failed.items():
        reason = use if isinstance(use, str) else f"spills {use.spilled}, with {use.registers} registers"
        print(f"{variant.label} for {target}: {reason}", file=sys.stderr)
    print(f"{len(variants)} kernels for {len(arguments.targets)} targets, {len(failed)} of {len(tasks)} wrong")
    if failed:
        return 1
    text = table(variants, arguments.targets, {task: use for task, use in found.items() if isinstance(use, Use)})
    if arguments.out is None:
        print(text)
    else:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
