"""What a run of the benchmark leaves: a table on the terminal, bench_splat.json and bench_splat.png."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict

from avatar.bench import Request
from avatar.bench.peak_memory import peak_memory
from avatar.bench.results import Line, Panel, write_report
from avatar.bench.splat import Row, Variant, all_variants, measure
from avatar.splat.scenes import HEAD_SPLATS

QUICK_SIZES, QUICK_COUNTS, QUICK_COUNT, QUICK_SIZE = (32, 64), (200, 500), 500, 64
USUAL_SIZES, USUAL_COUNTS = (256, 512), (HEAD_SPLATS, 50_000)
FULL_SIZES, FULL_COUNTS = (128, 256, 512, 1024), (1_000, 5_000, HEAD_SPLATS, 50_000, 200_000)


def run(request: Request) -> None:
    """Measure, print and write; `quick` takes scenes too small to say anything. A GPU is measured beside the CPU."""
    on_gpu = request.device != "cpu"
    if request.quick:
        variants = all_variants(
            QUICK_SIZES, QUICK_COUNTS, count=QUICK_COUNT, size=QUICK_SIZE, all_threads=True, on_gpu=on_gpu
        )
        repeats, validation_size = 3, QUICK_SIZE
    else:
        sizes, counts = (FULL_SIZES, FULL_COUNTS) if request.full else (USUAL_SIZES, USUAL_COUNTS)
        variants = all_variants(sizes, counts, all_threads=request.full, on_gpu=on_gpu)
        repeats, validation_size = 21, 512
    rows = measure(variants, repeats=repeats, validation_size=validation_size)
    is_measured = sys.platform == "linux" and not request.quick
    scenes = dict.fromkeys((row.variant.count, row.variant.size) for row in rows) if is_measured else ()
    memory = {scene: peak_memory(*scene) for scene in scenes}
    content = {
        "rows": [asdict(row) for row in rows],
        "memory": [{"count": count, "size": size, "bytes": found} for (count, size), found in memory.items()],
    }
    lines = [*table(rows), *(memory_table(memory) if memory else ())]
    write_report(request.out, "bench_splat", lines, content, panels(rows))


def table(rows: Iterable[Row]) -> list[str]:
    """Milliseconds as median (95th percentile); errors against the float64 reference with the usual cut-offs."""
    lines = [
        f"{'backend':>12} {'cut-off':>11} {'splats':>7} {'size':>5} {'threads':>7} {'forward ms':>17} {'backward ms':>17} "
        f"{'sum':>8} {'image error':>11} {'rms error':>9} {'gradient error':>14}"
    ]
    for row in rows:
        variant, accuracy, timing = row.variant, row.accuracy, row.timing
        backend = f"{variant.backend} {variant.simd}".strip()
        errors = (
            f"{accuracy.image:11.1e} {accuracy.rms:9.1e} {accuracy.gradient:14.1e}"
            if accuracy
            else f"{'is the truth':>36}"
        )
        lines.append(
            f"{backend:>12} {variant.changed or 'usual':>11} {variant.count:7,} {variant.size:5} {variant.threads:7} "
            f"{timing.forward!s:>17} {timing.backward!s:>17} {row.total:8.2f} {errors}"
        )
    return lines


def memory_table(memory: Mapping[tuple[int, int], int]) -> list[str]:
    """Of a forward and backward pass, whatever the instruction set and the number of threads."""
    lines = ["", f"{'splats':>7} {'size':>5} {'memory MB':>9}"]
    return [*lines, *(f"{count:7,} {size:5} {found / 1e6:9.1f}" for (count, size), found in memory.items())]


def panels(rows: Sequence[Row]) -> list[Panel]:
    """Both passes' time against the gradients' error where all sweeps cross, against resolution and number of splats."""
    truth = next(row.variant for row in rows if row.accuracy is None)
    scene, ms = (truth.count, truth.size), "forward + backward, ms"
    kinds: dict[str, list[Row]] = {}
    for row in rows:
        kinds.setdefault(kind_of(row.variant), []).append(row)
    by_error = []
    for name, own in kinds.items():
        here = [(row, row.accuracy) for row in own if (row.variant.count, row.variant.size) == scene and row.accuracy]
        notes = [row.variant.changed for row, _ in here]
        by_error.append(Line(name, [a.gradient for _, a in here], [row.total for row, _ in here], "o", notes))
    x = f"largest relative error of a gradient, {truth.count:,} splats, {truth.size} x {truth.size} pixels"
    found = [Panel(x, ms, [line for line in by_error if line.x])]
    for key, fixed, x in (
        ("size", "count", f"width and height in pixels, {truth.count:,} splats"),
        ("count", "size", f"splats, {truth.size} x {truth.size} pixels"),
    ):
        lines = []
        for name, own in kinds.items():
            there = sorted(
                (getattr(row.variant, key), row.total)
                for row in own
                if row.variant.has_usual_cutoffs and getattr(row.variant, fixed) == getattr(truth, fixed)
            )
            lines.append(Line(name, [value for value, _ in there], [time for _, time in there]))
        ticks = sorted({value for line in lines for value in line.x})
        found.append(Panel(x, ms, [line for line in lines if len(line.x) > 0], ticks=[int(tick) for tick in ticks]))
    return found


def kind_of(variant: Variant) -> str:
    """The name of a line."""
    if variant.backend != "cpu":
        return variant.backend
    return f"cpu {variant.simd}, threads: {variant.threads}"
