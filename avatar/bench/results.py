"""What a benchmark leaves in its folder: the figures as JSON and a plot."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avatar.bench.machine import describe_machine
from avatar.files.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def leave(folder: Path, name: str, content: Mapping[str, Any], draw: Callable[[Path], None] | None = None) -> None:
    """Write NAME.json, the content behind a description of the machine, and NAME.png, and say where they are."""
    figures, plot = folder / f"{name}.json", folder / f"{name}.png"
    text = json.dumps({"machine": describe_machine(), **content}, indent=1) + "\n"
    write_atomically(figures, text.encode())
    print(f"\nFigures  {figures}")
    if draw is not None:
        draw(plot)
        print(f"Plot     {plot}")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches, without a window."""
    from matplotlib.figure import Figure  # takes half a second; only commands that draw need it

    return Figure(figsize=(width, height), layout="constrained")
