"""The paper's benchmark of conditioning, n = 1 to 128: through the covariance against the inverse covariance trick.

    python scripts/paper/conditioning.py --out runs/paper

One forward and one backward pass of all three heads of a head's Gaussians (the paper's: one head of three values), with
the ways of `avatar.bench.hyper`, each compared with float64 before it is timed. Memory is Linux's high-water mark of a
process of its own: parameters, gradients and all between them. What takes too much is measured on fewer Gaussians, and
stated for all. A latent dimension that is measured is kept in --out/conditioning.
Leaves conditioning.md, conditioning.csv and conditioning.png in --out.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from write_report import machine, run, table, write_report

from avatar.bench.hyper import (
    COVARIANCE_FLOATS,
    COVARIANCE_TOLERANCE,
    LATENT_SIZES,
    TOLERANCE,
    WAYS,
    Leaves,
    Method,
    by_covariance,
    by_substitution,
    compare,
    covariance_leaves,
    random_heads,
)
from avatar.bench.results import new_figure
from avatar.files.atomic import write_atomically
from avatar.splat.scenes import HEAD_SPLATS

TEXTBOOK, TRICK, FUSED = "covariance, solver", "trick, solver", "trick, compiled"
PUBLISHED = {8: 2.5, 128: 151.0}  # naive / trick, RTX 2080 Ti, about 15,000 Gaussians, one head of three values
PUBLISHED_MB = {8: (42, 22)}
STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Point:
    """One way with one number of latent dimensions, for each Gaussian."""

    way: str
    n: int
    measured_on: int  # Gaussians
    nanoseconds: float  # forward and backward
    bytes: float | None  # None: not Linux


NAIVE = {TEXTBOOK: Method(by_covariance, covariance_leaves)}
TRICKS = {TRICK: WAYS["slope"], FUSED: WAYS["fused"]}


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sizes", type=int, nargs="+", default=LATENT_SIZES, help="latent dimensions")
    parser.add_argument("--gaussians", type=int, default=HEAD_SPLATS)
    parser.add_argument("--repeats", type=int, default=11)
    given = parser.parse_args(words)
    points: list[Point] = []
    for n in given.sizes:
        kept = given.out / "conditioning" / f"{given.gaussians}x{n}.json"
        if not kept.is_file():
            print(f"{n} latent dimensions", flush=True)
            write_atomically(kept, json.dumps([asdict(p) for p in measure(n, given.gaussians, given.repeats)]).encode())
        points += [Point(**point) for point in json.loads(kept.read_text())]
    report(given.out, points, given.gaussians)
    return 0


def measure(n: int, count: int, repeats: int) -> list[Point]:
    """Every way, after a comparison with float64 (UserError where it is wrong)."""
    few = min(count, COVARIANCE_FLOATS // (4 + n) ** 2)
    rows = compare(TRICKS, by_substitution, random_heads(count, n), repeats, TOLERANCE)
    for name, way in NAIVE.items():
        rows += compare({name: way}, way.offsets, random_heads(few, n), min(repeats, 5), COVARIANCE_TOLERANCE)
    memory = peaks(n, {row.way: row.gaussians for row in rows})
    return [
        Point(
            row.way,
            n,
            row.gaussians,
            1e6 * (row.forward.median + row.backward.median) / row.gaussians,
            memory[row.way] / row.gaussians if memory else None,
        )
        for row in rows
    ]


def peaks(n: int, counts: dict[str, int]) -> dict[str, int]:
    """Bytes of each way at its peak, in a process of its own; empty where Linux is not."""
    if not RESET.exists():
        return {}
    code = "import sys, conditioning; conditioning.say_peaks(sys.argv[1])"
    return json.loads(in_a_process_that_frees(code, json.dumps([n, counts])))


def in_a_process_that_frees(code: str, *words: str) -> str:
    """What Python code beside this file prints, where the allocator gives what is freed back to the system at once."""
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        cwd=Path(__file__).parent,
        env={**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536"},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def say_peaks(asked: str) -> None:
    """In the process of its own: print the bytes of every way as JSON."""
    n, counts = json.loads(asked)
    found = {}
    for name, way in {**TRICKS, **NAIVE}.items():
        one_pass(way, way.leaves(random_heads(16, n)))  # what a library makes once is not the way's
        found[name] = peak_bytes(way, way.leaves(random_heads(counts[name], n)))
    print(json.dumps(found))


def peak_bytes(way: Method, leaves: Leaves) -> int:
    gc.collect()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # glibc's
        trim(0)  # else what was freed before, and is still the process's, would hide what is taken
    RESET.write_text("5")
    before = high_water()
    one_pass(way, leaves)
    return high_water() - before + sum(leaf.nbytes for leaf in leaves.values())


def one_pass(way: Method, leaves: Leaves) -> None:
    offsets = way.offsets(leaves)
    torch.autograd.grad(offsets, list(leaves.values()), torch.ones_like(offsets))


def high_water() -> int:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


def report(folder: Path, points: Sequence[Point], count: int) -> None:
    ways = list(dict.fromkeys(point.way for point in points))
    sizes = list(dict.fromkeys(point.n for point in points))
    at = {(point.way, point.n): point for point in points}

    def cell(way: str, n: int) -> str:
        point = at[way, n]
        memory = "-" if point.bytes is None else f"{1e-6 * count * point.bytes:,.0f}"
        return f"{1e-6 * count * point.nanoseconds:,.2f}; {memory}"

    def ratio(n: int, value: Callable[[Point], float | None]) -> str:
        naive, trick = value(at[TEXTBOOK, n]), value(at[TRICK, n])
        return "-" if naive is None or trick is None else f"{naive / trick:.1f}"

    rows = [
        [
            str(n),
            *(cell(way, n) for way in ways),
            ratio(n, lambda point: point.nanoseconds),
            ratio(n, lambda point: point.bytes),
            f"{PUBLISHED[n]:g}" if n in PUBLISHED else "-",
        ]
        for n in sizes
    ]
    header = ["n", *ways, "naive / trick, time", "memory", "theirs, time"]
    page = [
        "# Conditioning through the covariance and by the inverse covariance trick",
        "",
        f"Milliseconds of a forward and a backward pass of {count:,} Gaussians with heads of 3, 4 and 3 values; MB at the",
        "peak, parameters and gradients included.",
        "",
        *table(header, rows),
        "",
        "Naive / trick: both with torch's batched solvers, as the paper compares. Theirs: one head of 3 values on an",
        f"RTX 2080 Ti; {' and '.join(map(str, PUBLISHED_MB[8]))} MB at n = 8. Where a table of covariances has more than",
        f"{COVARIANCE_FLOATS:,} values, fewer Gaussians were measured, and scaled: the CSV says how many.",
        "",
        machine(),
    ]
    fields = list(Point.__dataclass_fields__)
    figure = new_figure(10, 4)
    for axes, (field, title) in zip(
        figure.subplots(1, 2), (("nanoseconds", "forward + backward, ms"), ("bytes", "memory, MB")), strict=True
    ):
        for way in ways:
            own = [(p.n, 1e-6 * count * getattr(p, field)) for p in points if p.way == way and getattr(p, field)]
            axes.plot(*zip(*own, strict=True), "o-" if way in TRICKS else "s--", ms=4, label=way) if own else None
        axes.set(xscale="log", yscale="log", xlabel="latent dimensions n", ylabel=f"{title}, {count:,} Gaussians")
        axes.set_xticks(sizes, [str(n) for n in sizes])
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    write_report(folder, "conditioning", page, [fields, *([getattr(p, f) for f in fields] for p in points)], figure)


if __name__ == "__main__":
    run(main)
