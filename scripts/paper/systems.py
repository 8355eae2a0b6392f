"""The paper's systems on tracked folders, trained by `avatar sweep` into one folder that tables and figures share.

What is trained is kept: a run that was stopped goes on where it was, and a system that two tables or figures show is
trained once.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from avatar.cli import main as command
from avatar.files.atomic import write_atomically
from avatar.sweep.spec import Job, Spec, read_spec

HERE = Path(__file__).resolve().parent
TABLES = sorted(path.stem for path in HERE.glob("*.yaml"))
PROTOCOL = "hypergaussians"  # the paper's way of measuring

Rows = Sequence[Mapping[str, Any]]  # of a table's file


@dataclass(frozen=True)
class Request:
    """What every table and figure that trains is asked for."""

    folders: list[Path]
    overrides: list[str]
    out: Path
    head: Path | None
    frame_offset: int | None
    seeds: list[int]
    side_by_side: bool
    gpus: float | None

    def subjects(self) -> list[dict[str, Any]]:
        return [subject(folder, self.head, self.frame_offset) for folder in self.folders]


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("arguments", nargs="+", metavar="FOLDER or key=value", help="tracked folders, and overrides")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--head", type=Path, help="folder of the head model")
    parser.add_argument("--frame-offset", type=int, help="image number minus tracking number, where it is not clear")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of tables and figures that train through a sweep."""
    add_source_arguments(parser)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--side-by-side", action="store_true", help="a job for each processor; times do not compare")
    parser.add_argument("--gpus", type=float, help="of a job; 0.25 lets four share one, and times do not compare")


def folders_and_overrides(words: Sequence[str]) -> tuple[list[Path], list[str]]:
    """What is there is a folder, whatever its name."""
    overrides = [word for word in words if "=" in word and not Path(word).exists()]
    return [Path(word) for word in words if word not in overrides], overrides


def request_of(given: argparse.Namespace) -> Request:
    folders, overrides = folders_and_overrides(given.arguments)
    return Request(
        folders=folders,
        overrides=overrides,
        out=given.out,
        head=given.head,
        frame_offset=given.frame_offset,
        seeds=given.seeds,
        side_by_side=given.side_by_side,
        gpus=given.gpus,
    )


def read_table(name: str) -> dict[str, Any]:
    """The title and rows of a table's file."""
    return yaml.safe_load((HERE / f"{name}.yaml").read_text(encoding="utf-8"))


def systems(names: Sequence[str]) -> list[Mapping[str, Any]]:
    """The rows of these systems, whichever table has them."""
    known = {row["name"]: row for name in TABLES for row in read_table(name)["rows"] if "overrides" in row}
    if unknown := [name for name in names if name not in known]:
        raise SystemExit(f"there is no system {unknown[0]!r}; there are {', '.join(known)}")
    return [known[name] for name in names]


def train(request: Request, title: str, rows: Rows) -> tuple[int, Spec]:
    """Train and measure what is not there yet; `title` is the name of the file that says what.

    Returns the exit status of `avatar sweep`, 1 where some jobs failed, and the jobs.
    """
    path = request.out / f"{title}.yaml"
    write_sweep(path, request, rows)
    return command(["sweep", str(path), "--out", str(request.out)]), read_spec(path)


def write_sweep(path: Path, request: Request, rows: Rows) -> None:
    spec = sweep_spec(rows, request.subjects(), request.seeds, request.overrides)
    spec["threads"] = 1 if request.side_by_side else os.cpu_count() or 1
    if request.gpus is not None:
        spec["gpus"] = request.gpus
        spec["threads"] = max(1, int((os.cpu_count() or 1) * min(request.gpus, 1.0)))
    write_atomically(path, yaml.safe_dump(spec, sort_keys=False).encode())


def subject(folder: Path, head: Path | None, frame_offset: int | None) -> dict[str, Any]:
    """A subject of a sweep's file."""
    given = {"folder": str(folder.resolve()), "head": head and str(head.resolve()), "frame_offset": frame_offset}
    return {key: value for key, value in given.items() if value is not None}


def sweep_spec(
    rows: Rows, subjects: Sequence[Mapping[str, Any]], seeds: Sequence[int], overrides: Sequence[str]
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


def run_of(folder: Path, job: Job) -> Path:
    return folder / "jobs" / job.name / "run"


def is_measured(folder: Path, job: Job) -> bool:
    return (run_of(folder, job) / "eval" / "results.json").is_file()
