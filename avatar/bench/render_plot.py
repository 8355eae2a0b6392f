"""Where the time of a frame goes, as stacked bars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from avatar.bench.results import new_figure

if TYPE_CHECKING:
    from avatar.bench.render import Row


def write_plot(rows: Sequence[Row], path: Path) -> None:
    figure = new_figure(10, 1.6 + 0.8 * len(rows))
    steps, rates = figure.subplots(1, 2, width_ratios=(3, 1))
    names = [f"{row.size} px" for row in rows]
    done = [0.0] * len(rows)
    for step in rows[0].steps:
        spans = [row.steps[step].median for row in rows]
        steps.barh(names, spans, left=done, label=step)
        done = [a + b for a, b in zip(done, spans, strict=True)]
    steps.set_xlabel("milliseconds of one frame with one thread")
    if rows[0].steps:
        steps.legend(fontsize=8, ncols=6, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    bars = rates.barh(names, [row.stream_fps for row in rows], color="0.4")
    rates.bar_label(bars, fmt="%.0f", padding=3, fontsize=8)
    rates.margins(x=0.2)
    rates.set_xlabel("frames per second, streamed")
    for axes in (steps, rates):
        axes.invert_yaxis()
    figure.savefig(path, dpi=90)
