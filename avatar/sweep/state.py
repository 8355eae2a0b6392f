"""What is known of a sweep's jobs: one folder each, with files that any engine, on any machine, reads and writes.

SWEEP/sweep.json               the jobs and what one takes
SWEEP/jobs/NAME/job.json       what it trains
SWEEP/jobs/NAME/state.json     what became of it
SWEEP/jobs/NAME/log.txt        what its commands said, the newest; log.txt.old what came before
SWEEP/jobs/NAME/output.txt     what libraries printed, if they did
SWEEP/jobs/NAME/run/           the run
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from avatar.data.json_values import parse_object
from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.files.read import MissingFile, read_json
from avatar.sweep.output import end_of
from avatar.sweep.spec import Job, Resources, Spec

SWEEP_FILE = "sweep.json"
SWEEP_FORMAT = 1
HEARTBEAT_SECONDS = 5.0
SILENT_SECONDS = 60.0  # after which a running job counts as lost: its worker was killed, or its machine is gone

Status = Literal["waiting", "running", "done", "failed"]


@dataclass(frozen=True)
class State:
    """What became of a job."""

    status: Status = "waiting"
    attempts: int = 0
    worker: str = ""  # machine and process
    sentence: str = ""  # why it failed
    seconds: float = 0.0  # of work, over all attempts
    is_final: bool = False  # a failure that another attempt would repeat


def write_sweep(folder: Path, spec: Spec) -> list[str]:
    """Write the sweep, with the jobs that are not there yet. Returns the names of those that it had before and that `spec`
    does not have: their files stay.

    Raises UserError for a folder that holds another sweep's jobs.
    """
    before = _read_sweep_file(folder).get("jobs", []) if (folder / SWEEP_FILE).is_file() else []
    new = []
    for job in spec.jobs:
        place = folder / "jobs" / job.name
        if not (place / "job.json").is_file():
            new.append((place, job))
        elif read_job(place) != job:
            raise UserError(
                f"{folder} holds a sweep in which {job.name} is something else; choose another --out, or delete it"
            )
    for place, job in new:
        write_atomically(place / "job.json", json.dumps(asdict(job), indent=1, allow_nan=False).encode())
    names = [job.name for job in spec.jobs]
    content = {
        "format": SWEEP_FORMAT,
        "jobs": names,
        "resources": asdict(spec.resources),
        "retries": spec.retries,
    }
    write_atomically(folder / SWEEP_FILE, json.dumps(content, indent=1, allow_nan=False).encode())
    return sorted({*map(str, before)} - {*names}) if isinstance(before, list) else []


def read_sweep(folder: Path) -> Spec:
    """The sweep in a folder. Raises UserError where there is none."""
    raw = _read_sweep_file(folder)
    try:
        resources = parse_object({**asdict(Resources()), **raw["resources"]}, Resources, "resources")
        return Spec(
            tuple(read_job(folder / "jobs" / str(name)) for name in raw["jobs"]), resources, int(raw["retries"])
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{folder / 'sweep.json'} is damaged ({error}); start the sweep again") from None


def read_job(folder: Path) -> Job:
    raw = _read_json(folder / "job.json", f"{folder} holds no job of a sweep")
    try:
        job = Job.from_dict(raw)
        if job.name != folder.name:
            raise ValueError(f"it is the job {job.name!r}")
        return job
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{folder / 'job.json'} is damaged ({error}); delete the folder and start the sweep again"
        ) from None


def read_state(folder: Path) -> State:
    """A job's state; one that says `running` and has been silent for a minute is waiting again."""
    state = stored_state(folder)
    if state.status == "running" and heartbeat_age(folder) > SILENT_SECONDS:
        return replace(state, status="waiting")
    return state


def stored_state(folder: Path) -> State:
    """A job's state as it was last written."""
    try:
        return State(**read_json(folder / "state.json"))
    except (UserError, TypeError):
        return State()  # there is none, or a crash of the machine has torn it: the job is idempotent


def write_state(folder: Path, state: State) -> None:
    write_atomically(folder / "state.json", json.dumps(asdict(state), allow_nan=False).encode())


def write_heartbeat(folder: Path, computed: int) -> None:
    """Say that the job's worker lives, and the seconds of processor time that it has used."""
    with suppress(OSError):  # a disk that is full for a moment; who stays silent is missed
        (folder / "heartbeat").write_text(str(computed))


def progress_mark(folder: Path) -> bytes:
    """Changes while the job's worker computes or says something; a worker that hangs leaves it as it is."""
    return end_of(folder / "heartbeat") + b" " + end_of(folder / "log.txt")


def heartbeat_age(folder: Path) -> float:
    """Seconds since the worker last said that it lives, by the clock of the file's machine as far as this one can tell."""
    try:
        return time.time() - (folder / "heartbeat").stat().st_mtime
    except FileNotFoundError:
        return float("inf")


def _read_sweep_file(folder: Path) -> Mapping[str, Any]:
    raw = _read_json(folder / SWEEP_FILE, f"{folder} holds no sweep; start one with avatar sweep SPEC.yaml --out")
    if raw.get("format") != SWEEP_FORMAT:
        raise UserError(f"{folder / 'sweep.json'} was written by another version of this program; start a new sweep")
    return raw


def _read_json(path: Path, absent: str) -> Mapping[str, Any]:
    try:
        raw = read_json(path)
    except MissingFile:
        raise UserError(absent) from None
    if not isinstance(raw, dict):
        raise UserError(f"{path} holds no object")
    return raw
