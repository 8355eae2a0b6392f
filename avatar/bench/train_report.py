"""What `avatar bench train FOLDER` leaves: a table on the terminal, bench_train.json and bench_train.png."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from avatar.bench import Request
from avatar.bench.results import new_figure, write_report
from avatar.bench.train import ONCE_A_FRAME, Row, as_json, measure, share_of_faithful

REPEATS, QUICK_REPEATS, FULL_REPEATS = 15, 2, 41


def run(request: Request) -> None:
    """Measure, print and write; `quick` takes an avatar too small to say anything."""
    repeats = QUICK_REPEATS if request.quick else FULL_REPEATS if request.full else REPEATS
    rows = measure(request, repeats)
    content = {
        "folder": str(request.inputs[0]),
        "overrides": list(request.overrides),
        "rows": as_json(rows),
    }
    write_report(request.out, "bench_train", table(rows), content, lambda path: write_plot(rows, path))


def table(rows: Sequence[Row]) -> list[str]:
    """Milliseconds of a step as median (95th percentile), then of the stages of a step with the perceptual term."""
    lines = [
        f"{'recipe':>9} {'Gaussians':>9} {'network at':>10} {'parameters':>10} {'ms, first half':>17} "
        f"{'ms, second half':>17} {'faster':>7}"
    ]
    faster = share_of_faithful(rows)
    for row in rows:
        early, late = (f"{time.median:.1f} ({time.p95:.1f})" for time in (row.early, row.late))
        lines.append(
            f"{row.recipe:>9} {row.gaussians:9,} {row.places:10,} {row.parameters:10,} {early:>17} {late:>17} "
            f"{faster[row.recipe]:6.1f}x"
        )
    names = stage_names(rows)
    if not names:
        return lines
    heading = "stage: forward / backward (floor)"
    lines += ["", f"{heading:>40} {''.join(f'{row.recipe:>24}' for row in rows)}"]
    for name in names:
        lines.append(f"{name:>40} {''.join(f'{stage_cell(row, name):>24}' for row in rows)}")
    lines.append(f"{'sum without ' + ', '.join(ONCE_A_FRAME):>40} {''.join(f'{stage_sum(row):24.1f}' for row in rows)}")
    return lines


def stage_names(rows: Sequence[Row]) -> list[str]:
    """The stages of all rows in the order of a step; the row with most of them knows it."""
    longest = max(rows, key=lambda row: len(row.stages))
    return list(dict.fromkeys(name.removesuffix(", backward") for name in longest.stages))


def stage_cell(row: Row, name: str) -> str:
    if name not in row.stages:
        return "-"
    forward, backward = row.stages[name], row.stages.get(f"{name}, backward")
    times = f"{forward.median:.2f}" + (f" / {backward.median:.2f}" if backward else "")
    return times + (f" ({row.floors[name]:.1f})" if name in row.floors else "")


def stage_sum(row: Row) -> float:
    return sum(time.median for name, time in row.stages.items() if name not in ONCE_A_FRAME)


def write_plot(rows: Sequence[Row], path: Path) -> None:
    """One bar a recipe, stacked by stage."""
    figure = new_figure(9, 3.6)
    axes = figure.subplots()
    left = {row.recipe: 0.0 for row in rows}
    for index, name in enumerate(name for name in stage_names(rows) if name not in ONCE_A_FRAME):
        for row in rows:
            width = sum(row.stages[key].median for key in (name, f"{name}, backward") if key in row.stages)
            axes.barh(row.recipe, width, left=left[row.recipe], color=f"C{index % 10}", label=name)
            left[row.recipe] += width
    if not stage_names(rows):
        axes.barh([row.recipe for row in rows], [row.late.median for row in rows], label="second half")
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    axes.legend(unique.values(), unique.keys(), fontsize=8, ncols=2)
    axes.invert_yaxis()
    counts = sorted({row.gaussians for row in rows})
    title = f"{' to '.join(f'{count:,}' for count in dict.fromkeys((counts[0], counts[-1])))} Gaussians"
    axes.set(xlabel="milliseconds of a training step, forward and backward", title=title)
    axes.grid(alpha=0.3, axis="x")
    figure.savefig(path, dpi=100)
