"""What a table or figure leaves: NAME.md, NAME.csv and NAME.png, each whole or not at all; and its exit."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from avatar.bench.machine import describe_machine
from avatar.errors import UserError
from avatar.files.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 100


def write_report(
    folder: Path, name: str, page: Sequence[str], rows: Iterable[Sequence[object]], figure: Figure
) -> None:
    """Write and say where. `page` are the lines of the Markdown, `rows` those of the CSV, the first its header."""
    write_atomically(folder / f"{name}.md", ("\n".join(page) + "\n").encode())
    write_atomically(folder / f"{name}.csv", as_csv(rows).encode())
    image = io.BytesIO()
    figure.savefig(image, dpi=DPI, format="png")
    write_atomically(folder / f"{name}.png", image.getvalue())
    print("\n".join(["", *page, "", f"Wrote {folder / name}.{{md,csv,png}}"]))


def as_csv(rows: Iterable[Sequence[object]]) -> str:
    """None is an empty field."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerows(["" if value is None else value for value in row] for row in rows)
    return file.getvalue()


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a table in Markdown."""
    return [f"| {' | '.join(row)} |" for row in (header, ["---"] * len(header), *rows)]


def machine() -> str:
    """A sentence on where the figures were measured."""
    found = describe_machine()
    return (
        f"{found['processors']} cores of {found['processor']} ({found['simd'][-1]}), {found['threads']} threads, PyTorch "
        f"{found['torch']}, load {found['load']}."
    )


def run(main: Callable[[Sequence[str]], int]) -> None:
    """The script as a program: a mistake is a sentence."""
    try:
        sys.exit(main(sys.argv[1:]))
    except UserError as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {error}")
