"""What is known of a sweep's jobs: one folder each, with files that any engine, on any machine, reads and writes.

SWEEP/sweep.json               the jobs and what one takes
SWEEP/jobs/NAME/job.json       what it trains
SWEEP/jobs/NAME/state.json     what became of it
SWEEP/jobs/NAME/log.txt        what its commands said
SWEEP/jobs/NAME/run/           the run
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from avatar.errors import UserError
from avatar.files.atomic import write_atomically
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


def write_sweep(folder: Path, spec: Spec) -> None:
    """Write the jobs that are not there yet. Raises UserError for a folder that holds another sweep's jobs."""
    known = {job.name: job for job in read_jobs(folder)} if (folder / SWEEP_FILE).is_file() else {}
    for job in spec.jobs:
        if job.name in known and known[job.name] != job:
            raise UserError(
                f"{folder} holds a sweep in which {job.name} is something else; choose another --out, or delete it"
            )
        if job.name not in known:
            write_atomically(folder / "jobs" / job.name / "job.json", json.dumps(job.to_dict(), indent=1).encode())
    names = list(dict.fromkeys([*known, *(job.name for job in spec.jobs)]))
    content = {
        "format": SWEEP_FORMAT,
        "jobs": names,
        "resources": asdict(spec.resources),
        "retries": spec.retries,
    }
    write_atomically(folder / SWEEP_FILE, json.dumps(content, indent=1).encode())


def read_sweep(folder: Path) -> Spec:
    """The sweep in a folder. Raises UserError where there is none."""
    raw = _read_json(folder / SWEEP_FILE, f"{folder} holds no sweep; start one with avatar sweep SPEC.yaml --out")
    if raw.get("format") != SWEEP_FORMAT:
        raise UserError(f"{folder / 'sweep.json'} was written by another version of this program; start a new sweep")
    try:
        resources = Resources(**raw["resources"])
        return Spec(
            tuple(read_job(folder / "jobs" / str(name)) for name in raw["jobs"]), resources, int(raw["retries"])
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{folder / 'sweep.json'} is damaged ({error}); start the sweep again") from None


def read_jobs(folder: Path) -> tuple[Job, ...]:
    return read_sweep(folder).jobs


def read_job(folder: Path) -> Job:
    raw = _read_json(folder / "job.json", f"{folder} holds no job of a sweep")
    try:
        return Job.from_dict(raw)
    except (KeyError, TypeError) as error:
        raise UserError(
            f"{folder / 'job.json'} is damaged ({error}); delete the folder and start the sweep again"
        ) from None


def read_state(folder: Path) -> State:
    """A job's state; one that says `running` and has been silent for a minute is waiting again."""
    path = folder / "state.json"
    try:
        raw = json.loads(path.read_bytes())
        state = State(**raw)
    except FileNotFoundError:
        return State()
    except (OSError, ValueError, TypeError):
        return State()  # torn by a crash of the machine: the job is idempotent
    if state.status == "running" and silence(folder) > SILENT_SECONDS:
        return replace(state, status="waiting")
    return state


def write_state(folder: Path, state: State) -> None:
    write_atomically(folder / "state.json", json.dumps(asdict(state)).encode())


def beat(folder: Path) -> None:
    """Say that the job's worker lives."""
    (folder / "heartbeat").touch()


def silence(folder: Path) -> float:
    """Seconds since the worker last said that it lives, by the clock of the file's machine as far as this one can tell."""
    try:
        return time.time() - (folder / "heartbeat").stat().st_mtime
    except FileNotFoundError:
        return float("inf")


def worker_name() -> str:
    return f"{platform.node()}:{os.getpid()}"


def _read_json(path: Path, absent: str) -> Mapping[str, Any]:
    try:
        raw = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise UserError(absent) from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read ({error})") from None
    if not isinstance(raw, dict):
        raise UserError(f"{path} holds no object")
    return raw
