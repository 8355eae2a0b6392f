"""Runs side by side: means over the frames that all of them were evaluated on, and paired differences to the first run.

Pairing by frame takes out what makes a frame hard for every avatar, so that a difference stands out from chance where the
intervals of the two means still overlap.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from avatar.errors import UserError
from avatar.evaluation.bootstrap import BlockBootstrap, Interval
from avatar.evaluation.evaluate import RESULTS_FORMAT
from avatar.evaluation.previous_results import MAX_TABLE_BYTES
from avatar.evaluation.protocol import NAME
from avatar.evaluation.tracking_source import Drive, Part, is_marked, legend, parts
from avatar.files.names import typed
from avatar.files.read import MissingFile, read_bytes, read_json
from avatar.runs.checkpoint import newest_step

NEEDED = {"data_hash", "head_fingerprint", "image_size", "perceptual", "protocols", "tracking"}  # of results.json
# What is read of results.json, where it is there: "*" is every other key, a list has its one form throughout.
_NUMBER = int | float
_MEANS = {"*": _NUMBER | None}
_BINS = [{"name": str, "from": _NUMBER | None, "to": _NUMBER | None, "frames": int, "means": _MEANS}]
_FIGURES = {
    "means": _MEANS,
    "frames_sha256": str,
    **dict.fromkeys(("by_held_out", "by_camera", "by_yaw", "by_expression_distance"), _BINS),
}
_ENTRY = {
    **_FIGURES,
    "tracked": _FIGURES,
    "driven_by": ("tracked", "refined"),
    "frames": [str],
    "lpips": {"note": str, "weights_sha256": str | None},
    "choices": {"summary": str},
    "bootstrap": {"block_frames": int},
}
_ROUND = {"run": str, "frames_trained_on": int, "measured_frames_trained_on": int}
FORM = {
    **dict.fromkeys(("data_hash", "head_fingerprint", "perceptual"), str),
    "image_size": [int],
    "notes": [str],
    "tracking": {"tracker": str, "tracked": str, "refined": str, "rounds": [_ROUND]},
    "protocols": {"*": _ENTRY},
}
# Those of its keys that are there in every evaluation, beside `NEEDED`.
_ALWAYS = {
    *("block_frames", "bootstrap", "choices", "driven_by", "frames_sha256", "lpips", "means"),
    *("measured_frames_trained_on", "rounds", "tracker", "weights_sha256"),
}
# Of results.json: what has to agree, and what it is called.
SAME = (("data_hash", "data"), ("head_fingerprint", "head model"), ("image_size", "image size"))
NOT_COMPARED = ("summary", "source")  # words about a protocol; every other choice has to agree


@dataclass(frozen=True)
class Evaluation:
    """What `avatar eval` left in a run."""

    label: str
    folder: Path  # RUN/eval
    results: Mapping[str, Any]

    def parts(self, protocol: str) -> dict[Drive, Part]:
        return parts(self.results["protocols"][protocol])

    def figures(self, protocol: str, drive: Drive) -> dict[str, dict[str, float]]:
        """Name of the frame -> figures, as the table of the frames holds them, in the order of time."""
        part = self.parts(protocol)[drive]
        path = self.folder / protocol / part.table
        try:
            data = read_bytes(path, MAX_TABLE_BYTES)
        except UserError as error:
            raise UserError(f"{error}; evaluate the run again") from None
        if hashlib.sha256(data).hexdigest() != part.figures["frames_sha256"]:
            raise UserError(f"{path} is not the file that results.json was written with; evaluate the run again")
        rows = sorted(csv.DictReader(io.StringIO(data.decode())), key=lambda row: float(row.get("time", 0)))
        try:
            return {row["name"]: {name: float(row[name]) for name in part.figures["means"]} for row in rows}
        except KeyError as error:
            raise UserError(f"{path} has no column {error}; evaluate the run again") from None


class Cell(NamedTuple):
    """One figure of one run."""

    mean: float  # over the frames in which it is finite for every run
    difference: float | None  # to the first run; None for the first run itself
    interval: Interval | None  # of the difference

    @property
    def is_clear(self) -> bool:
        """Whether the interval of the difference leaves out 0."""
        return self.interval is not None and not self.interval[0] <= 0.0 <= self.interval[1]


@dataclass(frozen=True)
class ProtocolComparison:
    """All runs by one protocol."""

    protocol: str
    drive: Drive  # by which tracking
    count: int  # of what the means are over, the same for all runs
    unit: str  # frames, for instance
    method: str  # of the intervals
    rows: Mapping[str, Sequence[Cell]]  # figure -> one cell per run


@dataclass(frozen=True)
class Comparison:
    labels: Sequence[str]  # of the runs
    marked: Sequence[bool]  # whether measured frames were refined through an avatar that had been trained on them
    perceptual: Sequence[str]  # the perceptual term that each was trained with
    protocols: Sequence[ProtocolComparison]
    tracking: Sequence[str]  # for people: what the figures of each tracking are
    notes: Sequence[str]  # for people: what was left out, and why


def compare_runs(runs: Sequence[Path], protocols: Sequence[str] | None = None) -> Comparison:
    """The runs by each protocol that all of them have, or by those named.

    Raises UserError for less than two runs, a run that was not evaluated, runs of other data, head model or image size
    than the first, and runs that have no protocol or no frame in common.
    """
    if len(runs) < 2:
        raise UserError("there is nothing to compare: give at least two runs")
    names = [path.resolve().name for path in runs]
    labels = [
        " ".join((name if names.count(name) == 1 else str(path)).split())  # a line break would end LaTeX's comment
        for name, path in zip(names, runs, strict=True)
    ]
    evaluations = [read_evaluation(label, path) for label, path in zip(labels, runs, strict=True)]
    for other in evaluations[1:]:
        check_same(evaluations[0], other)
    notes = [note for evaluation in evaluations for note in trained_since(evaluation)]
    comparisons = []
    for name in common_protocols(evaluations, protocols, notes):
        for drive in evaluations[0].parts(name):
            comparison = compare_protocol(evaluations, name, drive, notes)
            if comparison is not None:
                comparisons.append(comparison)
    if not comparisons:
        raise UserError(
            f"{' and '.join(labels)} cannot be compared: {'; '.join(notes) or 'no protocol is in all of them'}"
        )
    return Comparison(
        labels,
        [is_marked(each.results["tracking"]) for each in evaluations],
        [each.results["perceptual"] for each in evaluations],
        comparisons,
        legend([each.results["tracking"] for each in evaluations]),
        list(dict.fromkeys(notes)),
    )


def read_evaluation(label: str, run: Path) -> Evaluation:
    path = run / "eval" / "results.json"
    try:
        results = read_json(path)
    except MissingFile:
        raise UserError(f"{run} was not evaluated (there is no {path}): run avatar eval {typed(run)} first") from None
    except UserError as error:
        raise UserError(f"{error}; evaluate the run again") from None
    if not isinstance(results, dict) or results.get("format") != RESULTS_FORMAT:
        raise UserError(f"{path} was written by another version of this program; evaluate the run again")
    if missing := NEEDED - results.keys():
        raise UserError(f"{path} is damaged ({', '.join(sorted(missing))} missing); evaluate the run again")
    names = results["protocols"]
    if not isinstance(names, dict) or not all(NAME.fullmatch(name) for name in names):  # they name folders
        raise UserError(f"{path} is damaged (the names of its protocols); evaluate the run again")
    if wrong := _misfit(results, FORM):
        raise UserError(f"{path} is damaged ({wrong.lstrip('.')}): run avatar eval {typed(run)} again")
    return Evaluation(label, path.parent, results)


def _misfit(value: Any, form: Any, where: str = "") -> str:
    """The first place where a value has another form, or lacks a key of `_ALWAYS`; empty where it has this one."""
    if isinstance(form, dict) and isinstance(value, dict):
        if lacking := sorted(_ALWAYS & form.keys() - value.keys()):
            return f"{where}.{lacking[0]}"
        found = (_misfit(one, form.get(key, form.get("*", object)), f"{where}.{key}") for key, one in value.items())
        return next(filter(None, found), "")
    if isinstance(form, list) and isinstance(value, list):
        return next(filter(None, (_misfit(one, form[0], f"{where}[{n}]") for n, one in enumerate(value))), "")
    if isinstance(form, tuple):
        return "" if value in form else where
    return where if isinstance(form, (dict, list)) or not isinstance(value, form) else ""


def check_same(first: Evaluation, other: Evaluation) -> None:
    """Figures of other data, another head model or another image size say nothing about which avatar is better."""
    for key, what in SAME:
        ours, theirs = first.results[key], other.results[key]
        if ours != theirs:
            shown = [
                str(value)[:12] if isinstance(value, str) else "x".join(map(str, value)) for value in (theirs, ours)
            ]
            another = f"other {what}" if key == "data_hash" else f"another {what}"
            raise UserError(f"{other.label} was evaluated on {another} than {first.label} ({shown[0]}, not {shown[1]})")


def trained_since(evaluation: Evaluation) -> list[str]:
    """A note where the run has gone on since it was measured."""
    step, newest = evaluation.results.get("step"), newest_step(evaluation.folder.parent)
    if step is None or newest in (None, step):
        return []
    return [f"{evaluation.label} was measured at step {step}, and its newest checkpoint is of step {newest}"]


def common_protocols(evaluations: Sequence[Evaluation], wanted: Sequence[str] | None, notes: list[str]) -> list[str]:
    """Names of the protocols that all runs have with the same choices; those that are left out go into `notes`."""
    first, *others = evaluations
    chosen = []
    words = wanted or first.results["protocols"]
    for name in dict.fromkeys(Path(word).stem for word in words):  # a file's name names its protocol
        lacking = [each.label for each in evaluations if name not in each.results["protocols"]]
        differing = {
            key
            for other in others
            if not lacking
            for key, value in other.results["protocols"][name]["choices"].items()
            if key not in NOT_COMPARED and value != first.results["protocols"][name]["choices"].get(key)
        }
        if lacking:
            notes.append(f"{name} was not measured for {', '.join(lacking)}")
        elif differing:
            notes.append(f"{name} differs between the runs in {', '.join(sorted(differing))}")
        else:
            chosen.append(name)
    return chosen


def compare_protocol(
    evaluations: Sequence[Evaluation], name: str, drive: Drive, notes: list[str]
) -> ProtocolComparison | None:
    """The comparison over the frames that all runs have; None, with a note, where there are none."""
    if lacking := [evaluation.label for evaluation in evaluations if drive not in evaluation.parts(name)]:
        notes.append(f"{name} was not measured by the {drive} tracking for {', '.join(lacking)}")
        return None
    tables = [evaluation.figures(name, drive) for evaluation in evaluations]
    frames = [frame for frame in tables[0] if all(frame in table for table in tables)]
    if not frames:
        notes.append(f"{name} was measured on frames of which none is in all runs")
        return None
    if missing := len(set().union(*tables)) - len(frames):
        notes.append(
            f"{name}: {len(frames)} frames are in all runs, {missing} more in some; only the common ones count"
        )
    entries = [evaluation.results["protocols"][name] for evaluation in evaluations]
    networks = {entry["lpips"]["weights_sha256"] for entry in entries}
    if len(networks) > 1:
        notes.append(f"{name}: LPIPS is left out, because the runs were measured with different networks")
    block = max(1, min(entries[0]["bootstrap"]["block_frames"], len(frames) // 4))
    bootstrap = BlockBootstrap(len(frames), block)
    rows: dict[str, list[Cell]] = {}
    empty = []
    for figure in evaluations[0].parts(name)[drive].figures["means"]:
        if figure.startswith("lpips") and len(networks) > 1:
            continue
        if lacking := [
            each.label for each, table in zip(evaluations, tables, strict=True) if figure not in table[frames[0]]
        ]:
            notes.append(f"{name}: {figure} was not measured for {', '.join(lacking)}")
            continue
        values = np.array([[table[frame][figure] for frame in frames] for table in tables])
        values[:, ~np.isfinite(values).all(axis=0)] = np.nan
        if np.isnan(values).all():
            empty.append(figure)
            continue
        first, *others = values
        rows[figure] = [Cell(_mean(first), None, None), *(_cell(own, first, bootstrap) for own in others)]
    if empty:
        notes.append(f"{name}: in no frame of all runs is there {', '.join(empty)}")
    return ProtocolComparison(name, drive, len(frames), "frames", f"blocks of {block} frames", rows)


def _cell(values: np.ndarray, first: np.ndarray, bootstrap: BlockBootstrap) -> Cell:
    return Cell(_mean(values), _mean(values - first), bootstrap.interval(values - first))


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)].tolist()
    return math.fsum(finite) / len(finite)
