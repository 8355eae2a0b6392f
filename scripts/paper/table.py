"""Train, measure and tabulate the systems of one of the paper's tables; the paper's figures stand beside ours.

    python scripts/paper/table.py table1 FOLDER... --out runs/paper [--head HEAD] [--seeds 0 1 2] [key=value ...]

table1 and ablation are files beside this one. Everything is trained by `avatar sweep` into --out, so a run that was
stopped goes on where it was, and tables in one --out share the systems that they have in common. Jobs take turns, each
with all processors, so that their times compare. Overrides hold for every system, such as data.size=256.
Leaves TABLE.md, TABLE.csv and TABLE.png in --out.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from avatar.bench.render import inputs, stream_rate
from avatar.bench.results import new_figure
from avatar.cli import main as command
from avatar.commands.opening import open_trained
from avatar.errors import UserError
from avatar.evaluation.compare import Cell
from avatar.files.atomic import write_atomically
from avatar.model import Avatar
from avatar.render import Renderer
from avatar.sweep.results import fold_results
from avatar.sweep.spec import Job, Spec, read_spec
from avatar.sweep.state import read_state

HERE = Path(__file__).resolve().parent
PROTOCOL = "hypergaussians"  # the paper's way of measuring
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
    parser.add_argument("table", choices=sorted(path.stem for path in HERE.glob("*.yaml")))
    parser.add_argument("arguments", nargs="+", metavar="FOLDER or key=value", help="tracked folders, and overrides")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--head", type=Path, help="folder of the head model")
    parser.add_argument("--frame-offset", type=int, help="image number minus tracking number, where it is not clear")
    parser.add_argument("--systems", nargs="+", metavar="NAME", help="train these alone")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--side-by-side", action="store_true", help="a job for each processor; times do not compare")
    given = parser.parse_intermixed_args(words)
    overrides = [word for word in given.arguments if "=" in word]
    folders = [Path(word) for word in given.arguments if "=" not in word]
    content = yaml.safe_load((HERE / f"{given.table}.yaml").read_text(encoding="utf-8"))
    subjects = [subject(folder, given.head, given.frame_offset) for folder in folders]
    wanted = {"to_train": chosen(content["rows"], given.systems), "sweep": content["rows"]}
    paths = {name: given.out / f"{given.table}.{name}.yaml" for name in wanted}
    for name, rows in wanted.items():
        spec = sweep_spec(rows, subjects, given.seeds, overrides)
        spec["threads"] = 1 if given.side_by_side else os.cpu_count() or 1
        write_atomically(paths[name], yaml.safe_dump(spec, sort_keys=False).encode())
    status = command(["sweep", str(paths["to_train"]), "--out", str(given.out)])
    if status not in (0, 1):  # 1: some jobs failed, and the table says which are missing
        return status
    try:
        rows, notes = read_rows(given.out, read_spec(paths["sweep"]), content["rows"])
        leave(given.out, given.table, content["title"], rows, notes)
    except UserError as error:
        print(f"No table: {error}", file=sys.stderr)
        return 1
    return status


def chosen(rows: Sequence[Mapping[str, Any]], names: Sequence[str] | None) -> list[Mapping[str, Any]]:
    """The systems to train. The first always is: the others are compared with it."""
    known = [row["name"] for row in rows if "overrides" in row]
    if unknown := [name for name in names or () if name not in known]:
        raise SystemExit(f"there is no system {unknown[0]!r} to train; the table has {', '.join(known)}")
    return [row for row in rows if names is None or row["name"] in (known[0], *names)]


def subject(folder: Path, head: Path | None, frame_offset: int | None) -> dict[str, Any]:
    """A subject of a sweep's file."""
    given = {"folder": str(folder.resolve()), "head": head and str(head.resolve()), "frame_offset": frame_offset}
    return {key: value for key, value in given.items() if value is not None}


def sweep_spec(
    rows: Sequence[Mapping[str, Any]],
    subjects: Sequence[Mapping[str, Any]],
    seeds: Sequence[int],
    overrides: Sequence[str],
) -> dict[str, Any]:
    """The sweep's file, as a dictionary; systems without overrides are the paper's alone."""
    variants = {row["name"]: row["overrides"] for row in rows if "overrides" in row}
    return {
        "subjects": list(subjects),
        "variants": variants,
        "overrides": list(overrides),
        "seeds": list(seeds),
        "protocols": [PROTOCOL],
    }


def read_rows(folder: Path, spec: Spec, rows: Sequence[Mapping[str, Any]]) -> tuple[list[Row], list[str]]:
    """What the sweep has found for the table's systems, and remarks. Raises UserError where there is nothing yet."""
    comparison = fold_results(folder, spec)
    (measured,) = comparison.protocols
    notes = [f"Means of {measured.count} {measured.unit}.", *comparison.notes]
    found = []
    for row in rows:
        name = row["name"]
        cells: dict[str, Cell] = {}
        if name in comparison.labels:
            place = list(comparison.labels).index(name)
            cells = {figure: measured.rows[figure][place] for figure in FIGURES if figure in measured.rows}
        jobs = [job for job in spec.jobs if job.variant == name and (run_of(folder, job) / "eval").is_dir()]
        minutes = [read_state(folder / "jobs" / job.name).seconds / 60 for job in jobs]
        fps, parameters = drawn(run_of(folder, jobs[0]), jobs[0]) if jobs else (None, None)
        mean = statistics.mean(minutes) if minutes else None
        found.append(Row(name, cells, fps, mean, parameters, row.get("published", {})))
    return found, notes


def run_of(folder: Path, job: Job) -> Path:
    return folder / "jobs" / job.name / "run"


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
    return sum(value.numel() for name, value in state.items() if name.startswith(("deformation.", "hyper.", "ndgs.")))


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
    return f"{count / 1e6:.1f}M" if count >= 1e6 else f"{count // 1000}K"


def markdown(title: str, rows: Sequence[Row], notes: Sequence[str]) -> str:
    theirs = [f"theirs: {name if name == 'parameters' else name.upper()}" for name in THEIRS]
    lines = [f"# {title}", "", f"| {' | '.join((*COLUMNS, *theirs))} |", "|---" * (len(COLUMNS) + len(theirs)) + "|"]
    for row in rows:
        published = [theirs_of(row, name) for name in THEIRS]
        lines.append(f"| {' | '.join((*shown(row), *published))} |")
    legend = (
        "Theirs: as published, on other subjects and another machine. FPS: on this machine's processors, drawing alone. "
        "Minutes: training and evaluation. Parameters: of the network and the distributions."
    )
    return "\n".join([*lines, "", legend, *(f"\n{note}" for note in notes)]) + "\n"


def as_csv(rows: Sequence[Row]) -> str:
    """A line for each system; empty where nothing was measured or published."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    ours = (*FIGURES, "fps", "minutes", "parameters")
    writer.writerow(("system", *ours, *(f"published_{name}" for name in THEIRS)))
    for row in rows:
        means = [row.cells[name].mean if name in row.cells else "" for name in FIGURES]
        rest = ["" if value is None else value for value in (row.fps, row.minutes, row.parameters)]
        writer.writerow((row.name, *means, *rest, *(row.published.get(name, "") for name in THEIRS)))
    return file.getvalue()


def draw(rows: Sequence[Row], path: Path) -> None:
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
    image = io.BytesIO()
    figure.savefig(image, dpi=100, format="png")
    write_atomically(path, image.getvalue())


def leave(folder: Path, name: str, title: str, rows: Sequence[Row], notes: Sequence[str]) -> None:
    page = markdown(title, rows, notes)
    write_atomically(folder / f"{name}.md", page.encode())
    write_atomically(folder / f"{name}.csv", as_csv(rows).encode())
    draw(rows, folder / f"{name}.png")
    print(f"\n{page}\nTable {folder / name}.{{md,csv,png}}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
