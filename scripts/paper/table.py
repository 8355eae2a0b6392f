"""Train, measure and tabulate the systems of one of the paper's tables; the paper's figures stand beside ours.

    python scripts/paper/table.py table1 FOLDER... --out runs/paper [--head HEAD] [--seeds 0 1 2] [key=value ...]

table1 and ablation are files beside this one. Everything is trained by `avatar sweep` into --out, so a run that was
stopped goes on where it was, and tables in one --out share the systems that they have in common. Jobs take turns, each
with all processors, so that their times compare. Overrides hold for every system, such as data.size=256.
Leaves TABLE.md, TABLE.csv and TABLE.png in --out.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from systems import TABLES, Rows, add_arguments, is_measured, read_table, request_of, run_of, train, write_sweep
from write_report import run, table, write_report

from avatar.bench.render import inputs, stream_rate
from avatar.bench.results import new_figure
from avatar.errors import UserError
from avatar.evaluation.compare import Cell
from avatar.gaussians.base_model import Avatar
from avatar.render import Renderer
from avatar.runs.run import open_trained
from avatar.sweep.results import fold_results
from avatar.sweep.spec import Job, Spec, read_spec
from avatar.sweep.state import read_state

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = {"psnr": ("PSNR", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 5)}  # title, digits
COLUMNS = ("system", *(title for title, _ in FIGURES.values()), "FPS", "minutes", "parameters")
THEIRS = ("psnr", "ssim", "lpips", "fps", "parameters")
MISSING = "not measured"
FRAMES = 8  # different ones that the drawing is timed with


@dataclass(frozen=True)
class Row:
    """A system: what was found for it, and what the paper says."""

    name: str
    cells: Mapping[str, Cell]  # by the names in FIGURES; without those that were not measured
    fps: float | None
    minutes: float | None  # of training and evaluation, a job's mean
    parameters: int | None
    published: Mapping[str, Any]


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=TABLES)
    add_arguments(parser)
    parser.add_argument("--systems", nargs="+", metavar="NAME", help="train these alone")
    given = parser.parse_intermixed_args(words)
    request, content = request_of(given), read_table(given.table)
    whole = given.out / f"{given.table}.sweep.yaml"
    write_sweep(whole, request, content["rows"])
    status, _ = train(request, f"{given.table}.to_train", chosen(content["rows"], given.systems))
    if status not in (0, 1):  # 1: some jobs failed, and the table says which are missing
        return status
    try:
        rows, notes = read_rows(given.out, read_spec(whole), content["rows"])
    except UserError as error:
        print(f"No table: {error}", file=sys.stderr)
        return 1
    write_report(given.out, given.table, page(content["title"], rows, notes), as_rows(rows), draw(rows))
    return status


def chosen(rows: Rows, names: Sequence[str] | None) -> list[Mapping[str, Any]]:
    """The systems to train. The first always is: the others are compared with it."""
    known = [row["name"] for row in rows if "overrides" in row]
    if unknown := [name for name in names or () if name not in known]:
        raise SystemExit(f"there is no system {unknown[0]!r} to train; the table has {', '.join(known)}")
    return [row for row in rows if names is None or row["name"] in (known[0], *names)]


def read_rows(folder: Path, spec: Spec, rows: Rows) -> tuple[list[Row], list[str]]:
    """What the sweep has found for the table's systems, and remarks. Raises UserError where there is nothing yet."""
    comparison = fold_results(folder, spec)
    measured = comparison.protocols[0]  # driven by the tracker's tracking
    terms = f"Perceptual term in training: {', '.join(dict.fromkeys(comparison.perceptual))}."
    notes = [f"Means of {measured.count} {measured.unit}.", *comparison.tracking[:1], terms, *comparison.notes]
    found = []
    for row in rows:
        name = row["name"]
        cells: dict[str, Cell] = {}
        if name in comparison.labels:
            place = list(comparison.labels).index(name)
            cells = {figure: measured.rows[figure][place] for figure in FIGURES if figure in measured.rows}
        jobs = [job for job in spec.jobs if job.variant == name and is_measured(folder, job)]
        minutes = [read_state(folder / "jobs" / job.name).seconds / 60 for job in jobs]
        fps, parameters = drawn(run_of(folder, jobs[0]), jobs[0]) if jobs else (None, None)
        mean = statistics.mean(minutes) if minutes else None
        found.append(Row(name, cells, fps, mean, parameters, row.get("published", {})))
    return found, notes


def drawn(run: Path, job: Job) -> tuple[float, int]:
    """Frames per second of `avatar.render`, all threads, at the size of training, and the number of parameters."""
    trained = open_trained(run, job.source.get("head"))
    size = trained.config.data.size or trained.recording.width
    with torch.no_grad():
        rates = [
            stream_rate(Renderer(trained.avatar, trained.background), inputs(trained, size, FRAMES)) for _ in "123"
        ]
    return statistics.median(rates), count_parameters(trained.avatar)


def count_parameters(avatar: Avatar) -> int:
    """As the paper counts: the network and the distributions, without what every Gaussian has."""
    state = avatar.state_dict()
    return sum(value.numel() for name, value in state.items() if name.startswith(("deformation.", "hyper.")))


def shown(row: Row) -> list[str]:
    figures = [
        f"{row.cells[name].mean:.{digits}f}" if name in row.cells else MISSING for name, (_, digits) in FIGURES.items()
    ]
    count = MISSING if row.parameters is None else short(row.parameters)
    fps = MISSING if row.fps is None else f"{row.fps:.0f}"
    minutes = MISSING if row.minutes is None else f"{row.minutes:.1f}"
    return [row.name, *figures, fps, minutes, count]


def theirs_of(row: Row, name: str) -> str:
    value = row.published.get(name, "-")
    return f"{value:.{FIGURES[name][1]}f}" if isinstance(value, float) else str(value)


def short(count: int) -> str:
    return f"{count / 1e6:.1f}M" if count >= 1e6 else f"{count // 1000}K" if count else "0"


def page(title: str, rows: Sequence[Row], notes: Sequence[str]) -> list[str]:
    theirs = [f"theirs: {name if name == 'parameters' else name.upper()}" for name in THEIRS]
    cells = [[*shown(row), *(theirs_of(row, name) for name in THEIRS)] for row in rows]
    legend = (
        "Theirs: as published, on other subjects and another machine. FPS: on this machine's processors, drawing alone. "
        "Minutes: training and evaluation. Parameters: of the network and the distributions."
    )
    lines = [f"# {title}", "", *table([*COLUMNS, *theirs], cells), "", legend]
    return [*lines, *(line for note in notes for line in ("", note))]


def as_rows(rows: Sequence[Row]) -> list[list[object]]:
    """A line for each system; None where nothing was measured or published."""
    ours = (*FIGURES, "fps", "minutes", "parameters")
    lines: list[list[object]] = [["system", *ours, *(f"published_{name}" for name in THEIRS)]]
    for row in rows:
        means = [row.cells[name].mean if name in row.cells else None for name in FIGURES]
        rest = [row.fps, row.minutes, row.parameters, *(row.published.get(name) for name in THEIRS)]
        lines.append([row.name, *means, *rest])
    return lines


def draw(rows: Sequence[Row]) -> Figure:
    """Differences to the first system, ours with their intervals and the paper's, figure by figure."""
    figure = new_figure(12, 1.2 + 0.4 * len(rows))
    places = range(len(rows))
    for axes, (name, (title, _)) in zip(figure.subplots(1, len(FIGURES), sharey=True), FIGURES.items(), strict=True):
        for place, row in zip(places, rows, strict=True):
            if (cell := row.cells.get(name)) is not None:
                difference = cell.difference or 0.0
                axes.plot(difference, place, "o", color="C0", label="ours" if place == 0 else None)
                if cell.interval is not None:
                    axes.plot(cell.interval, (place, place), "-", color="C0")
            if name in row.published:
                axes.plot(row.published[name] - rows[0].published[name], place, "D", mfc="none", color="C1",
                          label="published, other data" if place == 0 else None)  # fmt: skip
        axes.axvline(0, color="grey", lw=0.8)
        axes.set(xlabel=f"{title}, difference to {rows[0].name}", yticks=places, yticklabels=[row.name for row in rows])
        axes.grid(alpha=0.3)
    figure.axes[0].invert_yaxis()
    figure.axes[0].legend(fontsize=8)
    return figure


if __name__ == "__main__":
    run(main)
