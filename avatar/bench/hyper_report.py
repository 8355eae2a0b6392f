"""What `avatar bench hyper` leaves: a table on the terminal, bench_hyper.json and bench_hyper.png."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict

import numpy as np

from avatar.bench import Request
from avatar.bench.hyper import LATENT_SIZES, QUICK_LATENT_SIZES, Row, measure
from avatar.bench.results import Line, Panel, write_report


def run(request: Request) -> None:
    """Measure, print and write; `quick` takes too few Gaussians to say anything."""
    rows = measure(QUICK_LATENT_SIZES, count=300, repeats=3) if request.quick else measure(LATENT_SIZES)
    content = {"rows": [asdict(row) for row in rows]}
    write_report(request.out, "bench_hyper", [*table(rows), "", *comparisons(rows)], content, panels(rows))


def table(rows: Sequence[Row]) -> list[str]:
    """Milliseconds as median (95th percentile); errors against float64."""
    lines = [
        f"{'n':>3} {'way':>16} {'Gaussians':>9} {'forward ms':>17} {'backward ms':>17} {'sum':>8} {'floor':>6} "
        f"{'ns each':>9} {'error':>8} {'gradients':>9}"
    ]
    for row in rows:
        floor = "" if row.floor is None else f"{row.floor:.2f}"
        lines.append(
            f"{row.latent_size:3} {row.way:>16} {row.gaussians:9,} {row.forward!s:>17} {row.backward!s:>17} "
            f"{total(row):8.2f} {floor:>6} {each(row):9,.0f} {row.offsets_error:8.1e} {row.gradient_error:9.1e}"
        )
    return lines


def comparisons(rows: Sequence[Row]) -> Iterator[str]:
    """The compiled operator against each other way and against the floor, and how straight its line over n is."""
    own = {row.latent_size: row for row in rows if row.way == "fused"}
    others = [name for name in dict.fromkeys(row.way for row in rows) if name != "fused"]
    yield f"{'n':>3} {'times the floor':>16} " + " ".join(f"{f'{name} / fused':>24}" for name in others)
    for n, row in own.items():
        ratios = [
            each(other) / each(row) for name in others for other in rows if (other.way, other.latent_size) == (name, n)
        ]
        floor = total(row) / (row.floor or float("nan"))
        yield f"{n:3} {floor:16.1f} " + " ".join(f"{ratio:24.1f}" for ratio in ratios)
    slope, start, deviation = straight_line({n: each(row) for n, row in own.items()})
    yield (
        f"fused: {start:.0f} ns + {slope:.1f} ns for each latent dimension, for each Gaussian, forward and backward; "
        f"no n is off that line by more than {deviation:.0%}"
    )


def straight_line(values: dict[int, float]) -> tuple[float, float, float]:
    """Slope and start of the line with the least squares of relative deviations, and the largest of these."""
    x, y = np.array(list(values)), np.array(list(values.values()))
    slope, start = np.polyfit(x, y, 1, w=1 / y)
    return float(slope), float(start), float(np.abs((start + slope * x) / y - 1).max())


def panels(rows: Sequence[Row]) -> list[Panel]:
    """Time of one Gaussian over the number of latent dimensions."""
    lines = []
    for way in dict.fromkeys(row.way for row in rows):
        own = [row for row in rows if row.way == way]
        lines.append(Line(way, [row.latent_size for row in own], [each(row) for row in own]))
    floors = {row.latent_size: 1e6 * row.floor / row.gaussians for row in rows if row.way == "fused" and row.floor}
    lines.append(Line("copying the same bytes", list(floors), list(floors.values()), "k--"))
    sizes = sorted({row.latent_size for row in rows})
    return [Panel("latent dimensions n", "forward + backward, ns per Gaussian", lines, ticks=sizes)]


def total(row: Row) -> float:
    return row.forward.median + row.backward.median


def each(row: Row) -> float:
    """Nanoseconds per Gaussian, forward and backward."""
    return 1e6 * total(row) / row.gaussians
