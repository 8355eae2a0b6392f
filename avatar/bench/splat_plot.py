"""Time of the splatter against error, against resolution and against the number of splats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from avatar.bench.results import new_figure
from avatar.bench.splat_gpu import ON_GPU

if TYPE_CHECKING:
    from avatar.bench.splat import Row


def write_plot(rows: Sequence[Row], path: Path) -> None:
    figure = new_figure(15, 5)
    by_error, by_size, by_count = figure.subplots(1, 3)
    truth = next(row for row in rows if row.variant.backend == "reference")  # where all sweeps cross
    count, size = truth.variant.count, truth.variant.size

    here = [row for row in rows if (row.variant.count, row.variant.size) == (count, size)]
    for mark, kind in (
        ("o", "instructions, threads"),
        ("v", "alpha_min"),
        ("^", "t_min"),
        ("s", "plain torch"),
        ("*", "GPU"),
    ):
        points = [(row, row.accuracy) for row in here if row.accuracy and kind_of(row) == kind]
        by_error.scatter(
            [a.gradient for _, a in points],
            [total(row) for row, _ in points],
            s=30,
            marker=mark,
            label=kind if points else None,
        )
        for row, accuracy in points:
            # The names of neighbours lean away from each other.
            offset, rotation, horizontal, vertical = {
                "alpha_min": ((2, 5), 60, "left", "bottom"),
                "t_min": ((2, -5), -60, "left", "top"),
            }.get(kind, ((-6, 0), 0, "right", "center") if row.variant.threads == 1 else ((6, 0), 0, "left", "center"))
            by_error.annotate(
                note(row),
                (accuracy.gradient, total(row)),
                xytext=offset,
                rotation=rotation,
                ha=horizontal,
                va=vertical,
                textcoords="offset points",
                fontsize=8,
            )
    by_error.axhline(total(truth), color="k", ls=":", label="reference (plain torch, float64)")
    by_error.set(xscale="log", ylabel="forward + backward, ms")
    by_error.set_xlabel(f"largest relative error of a gradient, {count:,} splats, {size} x {size} pixels")
    by_error.margins(x=0.25, y=0.15)

    best = here[0].variant.simd
    cpu = [row for row in rows if row.variant.simd == best and kind_of(row) == "instructions, threads"]
    for threads in sorted({row.variant.threads for row in cpu}):
        own = [row for row in cpu if row.variant.threads == threads]
        sizes = sorted((row.variant.size, total(row)) for row in own if row.variant.count == count)
        counts = sorted((row.variant.count, total(row)) for row in own if row.variant.size == size)
        for axes, line in ((by_size, sizes), (by_count, counts)):
            axes.plot(*zip(*line, strict=True), marker="o", ms=4, label=f"cpu {best}, threads: {threads}")
    for backend in sorted({row.variant.backend for row in rows if kind_of(row) == "GPU"}):
        own = [row for row in rows if row.variant.backend == backend]
        sizes = sorted((row.variant.size, total(row)) for row in own if row.variant.count == count)
        counts = sorted((row.variant.count, total(row)) for row in own if row.variant.size == size)
        for axes, line in ((by_size, sizes), (by_count, counts)):
            axes.plot(*zip(*line, strict=True), "*-", ms=5, label=backend)
    plain = sorted((row.variant.size, total(row)) for row in rows if row.variant.backend == "plain")
    by_size.plot(*zip(*plain, strict=True), "s-", color="tab:red", ms=4, label="plain torch, threads: 1")
    for axes, x in ((by_size, size), (by_count, count)):
        axes.plot(x, total(truth), "k*", label="reference (plain torch, float64)")
    for axes, key in ((by_size, "size"), (by_count, "count")):
        shown = sorted({getattr(row.variant, key) for row in cpu})
        axes.set_xscale("log")
        axes.set_xticks(shown, [f"{value:,}" for value in shown])
        axes.set_xticks([], minor=True)
    by_size.set(xlabel=f"width and height in pixels, {count:,} splats")
    by_count.set(xlabel=f"splats, {size} x {size} pixels")
    for axes in (by_error, by_size, by_count):
        axes.set(yscale="log")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=90)


def kind_of(row: Row) -> str:
    variant = row.variant
    if variant.backend == "plain":
        return "plain torch"
    if variant.backend in ON_GPU:
        return "GPU"
    if variant.has_usual_cutoffs:
        return "instructions, threads"
    return "t_min" if "T" in variant.changed else "alpha_min"


def note(row: Row) -> str:
    variant = row.variant
    if variant.backend in ("plain", *ON_GPU):
        return variant.backend
    return f"{variant.simd}, {variant.threads}" if variant.has_usual_cutoffs else variant.changed


def total(row: Row) -> float:
    """Milliseconds of both passes."""
    return row.timing.forward.median + row.timing.backward.median
