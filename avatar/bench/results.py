"""What a benchmark leaves in its folder: the figures as JSON, the table as Markdown and a plot."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avatar.bench.machine import describe_machine
from avatar.files.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_report(
    folder: Path,
    name: str,
    table: Sequence[str],
    content: Mapping[str, Any],
    draw: Callable[[Path], None] | None = None,
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
    if draw is not None:
        files["Plot"] = folder / f"{name}.png"
        draw(files["Plot"])
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


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches, without a window."""
    from matplotlib.figure import Figure  # takes half a second; only commands that draw need it

    return Figure(figsize=(width, height), layout="constrained")
