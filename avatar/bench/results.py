"""What a benchmark leaves in its folder: the figures as JSON, the table as Markdown and a plot."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avatar.bench.machine import describe_machine
from avatar.files.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Line:
    label: str
    x: Sequence[float]
    y: Sequence[float]
    style: str = "o-"
    notes: Sequence[str] = ()  # beside the points


@dataclass(frozen=True)
class Panel:
    """One pair of axes of a plot; both are logarithmic unless said otherwise."""

    x: str  # label
    y: str
    lines: Sequence[Line]
    log_y: bool = True
    ticks: Sequence[int] = ()  # along x, in place of powers of ten


def write_report(
    folder: Path, name: str, table: Sequence[str], content: Mapping[str, Any], panels: Sequence[Panel] = ()
) -> None:
    """Print the table and write NAME.md with it, NAME.json, the content behind a description of the machine, and NAME.png.

    Says where the files are.
    """
    for line in table:
        print(line)
    machine = describe_machine()
    files = {"Figures": folder / f"{name}.json", "Table": folder / f"{name}.md"}
    figures = _with_null({"machine": machine, **content})
    write_atomically(files["Figures"], (json.dumps(figures, indent=1, allow_nan=False) + "\n").encode())
    write_atomically(files["Table"], as_page(name, table, machine).encode())
    if panels:
        files["Plot"] = folder / f"{name}.png"
        draw(panels, files["Plot"])
    print()
    for label, path in files.items():
        print(f"{label:8} {path}")


def _with_null(value: Any) -> Any:
    """The value with null for each number that is not finite: a measure that nobody took."""
    if isinstance(value, dict):
        return {key: _with_null(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_with_null(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_page(name: str, table: Sequence[str], machine: Mapping[str, Any]) -> str:
    """The table as a page of Markdown, under the command that made it and the machine."""
    command = f"avatar bench {name.removeprefix('bench_')}"
    where = (
        f"{machine['processors']} cores of {machine['processor']} ({machine['simd'][-1]}), {machine['threads']} threads, "
        f"PyTorch {machine['torch']}, load {machine['load']}"
    )
    return "\n".join([f"# `{command}`", "", f"{where}.", "", "```", *table, "```", ""])


def draw(panels: Sequence[Panel], path: Path) -> None:
    figure = new_figure(5.5 * len(panels), 4.5)
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for line in panel.lines:
            axes.plot(line.x, line.y, line.style, ms=4, lw=1, label=line.label)
            for note, x, y in zip(line.notes, line.x, line.y, strict=bool(line.notes)):
                axes.annotate(note, (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7)
        axes.set(xscale="log", yscale="log" if panel.log_y else "linear", xlabel=panel.x, ylabel=panel.y)
        if panel.ticks:
            axes.set_xticks(panel.ticks, [f"{value:,}" for value in panel.ticks])
            axes.set_xticks([], minor=True)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=90)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches, without a window."""
    from matplotlib.figure import Figure  # takes half a second; only commands that draw need it

    return Figure(figsize=(width, height), layout="constrained")
