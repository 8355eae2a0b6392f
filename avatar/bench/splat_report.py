"""What a run of the benchmark leaves: a table on the terminal, bench_splat.json and bench_splat.png."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from avatar.bench import Request
from avatar.bench.floor import measured_copy_bandwidth, measured_flops
from avatar.bench.machine import available_simd
from avatar.bench.scenes import HEAD_SPLATS
from avatar.bench.splat import Row, all_variants, as_json, measure
from avatar.bench.splat_work import Work, floors, work_of

QUICK_SIZES, QUICK_COUNTS, QUICK_COUNT, QUICK_SIZE = (32, 64), (200, 500), 500, 64
USUAL_SIZES, USUAL_COUNTS = (256, 512), (HEAD_SPLATS, 50_000)
FULL_SIZES, FULL_COUNTS = (128, 256, 512, 1024), (1_000, 5_000, HEAD_SPLATS, 50_000, 200_000)


def run(request: Request) -> None:
    """Measure, print and write; `quick` takes scenes too small to say anything."""
    out = request.out
    if request.quick:
        variants = all_variants(QUICK_SIZES, QUICK_COUNTS, count=QUICK_COUNT, size=QUICK_SIZE)
        rows = measure(variants, repeats=3, validation_size=QUICK_SIZE)
    else:
        sizes, counts = (FULL_SIZES, FULL_COUNTS) if request.full else (USUAL_SIZES, USUAL_COUNTS)
        rows = measure(all_variants(sizes, counts), repeats=21, validation_size=512)
    for line in table(rows):
        print(line)
    works = [
        work_of(*scene, with_memory=not request.quick)
        for scene in dict.fromkeys((row.variant.count, row.variant.size) for row in rows)
    ]
    for line in work_table(rows, works):
        print(line)
    figures, plot = out / "bench_splat.json", out / "bench_splat.png"
    figures.write_text(json.dumps(as_json(rows, works), indent=1) + "\n", encoding="utf-8")
    write_plot(rows, plot)
    print(f"\nFigures  {figures}\nPlot     {plot}")


def table(rows: Iterable[Row]) -> list[str]:
    """Milliseconds as median (95th percentile); errors against the float64 reference."""
    lines = [
        f"{'backend':>18} {'splats':>7} {'size':>5} {'threads':>7} {'forward ms':>17} {'backward ms':>17} {'sum':>8} "
        f"{'image error':>11} {'gradient error':>14}"
    ]
    for row in rows:
        variant, accuracy, timing = row.variant, row.accuracy, row.timing
        forward = f"{timing.forward.median:.2f} ({timing.forward.p95:.2f})"
        backward = f"{timing.backward.median:.2f} ({timing.backward.p95:.2f})"
        errors = f"{accuracy.image:11.1e} {accuracy.gradient:14.1e}" if accuracy else f"{'is the truth':>26}"
        lines.append(
            f"{label(row):>18} {variant.count:7,} {variant.size:5} {variant.threads:7} {forward:>17} {backward:>17} "
            f"{total(row):8.2f} {errors}"
        )
    return lines


def work_table(rows: Sequence[Row], works: Sequence[Work]) -> list[str]:
    """What every scene asks for, and which part of the time of the fastest kernel the machine's own limits explain.

    Pairs are of a splat and a tile: by the exact ellipse, and by a square of three standard deviations.
    """
    best = [row for row in rows if row.variant.simd == available_simd()[-1]]
    lines = [
        "",
        f"{'splats':>7} {'size':>5} {'pairs':>9} {'by 3 sigma':>10} {'evaluated':>11} {'composited':>11} {'memory MB':>9} "
        f"{'threads':>7} {'floor ms':>13} {'reached':>13}",
    ]
    for work in works:
        n = work.counters
        memory = "-" if work.memory is None else f"{work.memory / 1e6:.1f}"
        for row in (r for r in best if (r.variant.count, r.variant.size) == (work.count, work.size)):
            limits = floors(work, row.variant.threads)
            times = row.timing.forward.median, row.timing.backward.median
            floor_cell = " + ".join(f"{limit:.1f}" for limit in limits)
            reached = " + ".join(f"{limit / time:.0%}" for limit, time in zip(limits, times, strict=True))
            lines.append(
                f"{work.count:7,} {work.size:5} {n['pairs']:9,} {n['pairs_in_squares']:10,} {n['pixels_evaluated']:11,} "
                f"{n['pixels_composited']:11,} {memory:>9} {row.variant.threads:7} {floor_cell:>13} "
                f"{reached:>13}"
            )
    for threads in sorted({row.variant.threads for row in best}):
        rates = measured_flops(threads) / 1e9, measured_copy_bandwidth(threads) / 1e9
        lines.append(
            f"The floor, threads {threads}: {rates[0]:.1f} GFLOP/s of a matrix product, {rates[1]:.1f} GB/s of a copy"
        )
    return lines


def label(row: Row) -> str:
    return f"{row.variant.backend} {row.variant.simd}".strip()


def write_plot(rows: Sequence[Row], path: Path) -> None:
    """Time against error, against resolution and against the number of splats."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # takes half a second; only this command needs it
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4), layout="constrained")
    FigureCanvasAgg(figure)
    by_error, by_size, by_count = figure.subplots(1, 3)
    measured = [(row, row.accuracy) for row in rows if row.accuracy]
    for name in dict.fromkeys(label(row) for row, _ in measured):
        points = [(a.gradient, total(row)) for row, a in measured if label(row) == name]
        by_error.scatter(*zip(*points, strict=True), s=18, label=name)
    by_error.set(xlabel="largest relative error of a gradient", ylabel="forward + backward, ms")

    slow = next(row for row in rows if row.variant.backend == "reference")  # where the two sweeps cross
    count, size = slow.variant.count, slow.variant.size
    best = measured[0][0].variant.simd
    cpu = [row for row, _ in measured if row.variant.simd == best]
    for threads in sorted({row.variant.threads for row in cpu}):
        own = [row for row in cpu if row.variant.threads == threads]
        sizes = sorted((row.variant.size, total(row)) for row in own if row.variant.count == count)
        counts = sorted((row.variant.count, total(row)) for row in own if row.variant.size == size)
        for axes, line in ((by_size, sizes), (by_count, counts)):
            axes.plot(*zip(*line, strict=True), marker="o", ms=4, label=f"cpu {best}, threads: {threads}")
    by_size.plot(size, total(slow), "k*", label="reference (plain torch, float64)")
    by_count.plot(count, total(slow), "k*", label="reference (plain torch, float64)")
    for axes, key in ((by_size, "size"), (by_count, "count")):
        shown = sorted({getattr(row.variant, key) for row in cpu})
        axes.set_xscale("log")
        axes.set_xticks(shown, [f"{value:,}" for value in shown])
        axes.set_xticks([], minor=True)
    by_error.set(xscale="log", xlim=(1e-7, 1e-4))
    by_size.set(xlabel=f"width and height in pixels, {count:,} splats")
    by_count.set(xlabel=f"splats, {size} x {size} pixels")
    for axes in (by_error, by_size, by_count):
        axes.set(yscale="log")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=90)


def total(row: Row) -> float:
    return row.timing.forward.median + row.timing.backward.median
