"""What a worker prints never holds it up, and one that hangs is found and ended."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from avatar.errors import UserError
from avatar.files.lock import locked
from avatar.sweep import run_sweep
from avatar.sweep import worker as workers
from avatar.sweep.engines import EngineOptions, LocalProcesses, make_engine
from avatar.sweep.output import BoundedLog, end_of, old_of
from avatar.sweep.run_sweep import run_jobs
from avatar.sweep.spec import Job, Resources, Spec
from avatar.sweep.state import State, progress_mark, read_state, write_heartbeat, write_state
from avatar.sweep.status import Progress
from avatar.sweep.worker import OUTPUT_FILE, Worker

JOB = Job("j", "s", "v", 0, {"folder": "/f"}, (), ())
SPEC = Spec((JOB,), Resources(threads=1, memory_gb=0.1), retries=0)


def run_instead(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell script stands in for the worker's Python."""
    script = folder / "python"
    script.write_text(f"#!/bin/sh\n{text}\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))


def reason_of_end(engine: LocalProcesses, folder: Path) -> str:
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        if (said := engine.poll(folder)) is not None:
            return said
        time.sleep(0.02)
    raise AssertionError("the worker does not end")


@pytest.mark.parametrize("stream", [1, 2], ids=["stdout", "stderr"])
def test_a_worker_that_prints_a_megabyte_past_python_does_not_hang(
    stream: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_instead(
        f"head -c 1000000 /dev/zero | tr '\\0' x >&{stream}; echo 'avatar: the end' >&2; exit 1", tmp_path, monkeypatch
    )
    engine = LocalProcesses(SPEC.resources, workers=1)
    engine.submit([tmp_path])
    assert reason_of_end(engine, tmp_path).endswith("the end")
    assert (tmp_path / OUTPUT_FILE).stat().st_size == 1_000_016


def test_what_a_worker_prints_is_bounded_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "BoundedLog", lambda path: BoundedLog(path, 100_000))
    run_instead("head -c 1000000 /dev/zero | tr '\\0' x; echo; echo 'the end'; exit 3", tmp_path, monkeypatch)
    assert Worker(tmp_path, 1).wait() == "the end"
    sizes = [path.stat().st_size for path in tmp_path.glob(f"{OUTPUT_FILE}*")]
    assert len(sizes) == 2 and max(sizes) <= 100_000


def test_a_worker_goes_on_where_its_output_cannot_be_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / OUTPUT_FILE).mkdir()
    run_instead("head -c 200000 /dev/zero; echo 'the end'; exit 1", tmp_path, monkeypatch)
    assert Worker(tmp_path, 1).wait().endswith("the end")


def test_a_worker_that_ignores_being_asked_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "GRACE_SECONDS", 0.2)
    run_instead("trap '' TERM; echo ready; while :; do sleep 0.05; done", tmp_path, monkeypatch)
    engine = LocalProcesses(SPEC.resources, workers=1)
    engine.submit([tmp_path])
    while not end_of(tmp_path / OUTPUT_FILE):
        time.sleep(0.02)
    engine.stop([tmp_path])
    assert reason_of_end(engine, tmp_path) == "the worker was killed by signal 9"


def test_the_log_keeps_what_is_new(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_bytes(b"before\n")
    with BoundedLog(path, 100) as log:
        for number in range(50):
            print(f"line {number:03}", file=log, flush=True)
        assert not log.isatty()
        log.write("half a surrogate \ud83d")
    assert path.stat().st_size <= 100 and old_of(path).stat().st_size <= 100
    assert b"line 049" in end_of(old_of(path)) + end_of(path)
    assert len(end_of(path, 5)) == 5 and end_of(tmp_path / "none") == b""


class Hanging:
    """An engine whose workers never end by themselves."""

    name = "hanging"

    def __init__(self, place: Path, computes: bool = False) -> None:
        self.place, self.computes, self.polls, self.ended = place, computes, 0, False

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        write_state(self.place, State("running", 1, "here:1"))
        write_heartbeat(self.place, 0)
        return list(folders)

    def poll(self, handle: Any) -> str | None:
        self.polls += 1
        if self.computes:
            write_heartbeat(self.place, self.polls)
            if self.polls == 5:
                write_state(self.place, State("done", 1))
                return ""
        return "killed by signal 9" if self.ended else None

    def stop(self, handles: Sequence[Any]) -> None:
        self.ended = True

    def close(self) -> None: ...


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(run_sweep, "STALLED_SECONDS", 0.05)
    monkeypatch.setattr(run_sweep, "POLL_SECONDS", 0.02)
    place = tmp_path / "jobs" / "j"
    place.mkdir(parents=True)
    return place


@pytest.mark.timeout(30)
def test_a_worker_whose_heartbeat_goes_on_without_progress_is_ended(place: Path) -> None:
    engine = Hanging(place)
    state = run_jobs(place.parents[1], SPEC, engine, Progress())["j"]
    assert engine.ended and state.status == "failed" and state.attempts == 1
    assert "the worker hung: no progress for" in state.sentence
    assert read_state(place) == state


def test_a_worker_that_computes_is_left_alone(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Hanging(place, computes=True)
    monkeypatch.setattr(run_sweep, "STALLED_SECONDS", 1.0)
    assert run_jobs(place.parents[1], SPEC, engine, Progress())["j"].status == "done"
    assert not engine.ended


class Queued(Hanging):
    """An engine that has no place for the job for a while."""

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        return list(folders)

    def poll(self, handle: Any) -> str | None:
        self.polls += 1
        if self.polls < 10:
            return None
        write_state(self.place, State("done", 2))
        return ""


@pytest.mark.timeout(30)
def test_a_job_that_waits_for_a_place_does_not_hang_whatever_a_crash_has_left_of_it(place: Path) -> None:
    write_state(place, State("running", 1, "here:1"))
    write_heartbeat(place, 3)
    os.utime(place / "heartbeat", (time.time() - 120, time.time() - 120))
    engine = Queued(place)
    assert run_jobs(place.parents[1], SPEC, engine, Progress())["j"] == State("done", 2)
    assert not engine.ended


@pytest.mark.timeout(30)
def test_a_worker_of_another_sweep_that_hangs_is_named_and_not_waited_for(place: Path) -> None:
    write_state(place, State("running", 1, "elsewhere:17"))
    write_heartbeat(place, 3)
    state = run_jobs(place.parents[1], SPEC, Hanging(place), Progress())["j"]
    assert state.status == "failed" and "elsewhere:17 hangs" in state.sentence
    assert json.loads((place / "state.json").read_text())["status"] == "running", "it is not ours"


class TakenByAnother(Hanging):
    """An engine whose worker finds that another sweep's has the job."""

    submissions = 0

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        self.submissions += 1
        write_state(self.place, State("running", 1, "elsewhere:17"))
        write_heartbeat(self.place, 3)
        return list(folders)

    def poll(self, handle: Any) -> str | None:
        with pytest.raises(UserError) as error, locked(self.place):
            pass
        return str(error.value)


@pytest.mark.timeout(30)
def test_a_job_that_another_sweep_has_taken_is_waited_for(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engine, looks = TakenByAnother(place), list[str]()
    monkeypatch.setattr(run_sweep, "STALLED_SECONDS", 10.0)

    def look(progress: Progress, states: dict[str, State], last: bool = False) -> None:
        looks.append(json.loads((place / "state.json").read_text())["status"])
        if len(looks) == 3:
            write_state(place, State("done", 1, "elsewhere:17"))

    monkeypatch.setattr(Progress, "show", look)
    with locked(place):
        state = run_jobs(place.parents[1], SPEC, engine, Progress())["j"]
    assert state == State("done", 1, "elsewhere:17") and engine.submissions == 1
    assert looks[:3] == ["running"] * 3, "nothing is written over"


def test_progress_is_processor_time_or_something_said(tmp_path: Path) -> None:
    write_heartbeat(tmp_path, 3)
    mark = progress_mark(tmp_path)
    write_heartbeat(tmp_path, 3)
    assert progress_mark(tmp_path) == mark
    write_heartbeat(tmp_path, 4)
    computed = progress_mark(tmp_path)
    (tmp_path / "log.txt").write_text("step 1")
    assert len({mark, computed, progress_mark(tmp_path)}) == 3


def test_slurm_is_refused_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="no SLURM on this machine"):
        make_engine("slurm", SPEC, tmp_path, EngineOptions())


LISTENING = """
import os
from pathlib import Path
from avatar.sweep.engines import EngineOptions, make_engine
from avatar.sweep.spec import Resources, Spec

engine = make_engine("ray", Spec((), Resources(threads=1, memory_gb=0.1), 0), Path(), EngineOptions(workers=1))
parents = {}
for process in Path("/proc").glob("[0-9]*"):
    try:
        parents[int(process.name)] = int((process / "stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        pass
def is_ours(process):
    return process == os.getpid() or (process in parents and is_ours(parents[process]))
sockets = set()
for process in filter(is_ours, list(parents)):
    for file in Path(f"/proc/{process}/fd").iterdir():
        try:
            sockets.add(os.readlink(file))
        except OSError:
            pass
for family in ("tcp", "tcp6"):
    for line in Path(f"/proc/net/{family}").read_text().splitlines()[1:]:
        words = line.split()
        if words[3] == "0A" and f"socket:[{words[9]}]" in sockets:
            print("listens", words[1].partition(":")[0])
engine.close()
"""


@pytest.mark.slow
def test_a_ray_of_its_own_listens_on_the_loopback_interface_alone() -> None:
    pytest.importorskip("ray")
    if not Path("/proc/net/tcp").is_file():
        pytest.skip("there is no /proc to see sockets in")
    clean = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    done = subprocess.run([sys.executable, "-c", LISTENING], env=clean, capture_output=True, text=True, check=True)
    addresses = {line.split()[1] for line in done.stdout.splitlines() if line.startswith("listens")}
    assert addresses and addresses <= {
        "0100007F",
        "0000000000000000FFFF00000100007F",
        "00000000000000000000000001000000",
    }
