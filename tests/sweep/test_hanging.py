"""A worker that hangs is found and ended; one that waits, computes or belongs to another sweep is not."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from avatar.errors import UserError
from avatar.files.lock import locked
from avatar.sweep import run_sweep
from avatar.sweep.run_sweep import run_jobs
from avatar.sweep.spec import Job, Resources, Spec
from avatar.sweep.state import State, read_state, write_heartbeat, write_state
from avatar.sweep.status import Progress

JOB = Job("j", "s", "v", 0, {"folder": "/f"}, (), ())
SPEC = Spec((JOB,), Resources(threads=1, memory_gb=0.1), retries=0)


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


class Again(Hanging):
    """An engine whose first worker hangs; the next one says that it has the job before it says that it lives."""

    stops, polls_of_next = 0, 0

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        if self.stops == 0:
            return super().submit(folders)
        write_state(self.place, State("running", 2, "here:2"))
        return list(folders)

    def poll(self, handle: Any) -> str | None:
        if self.stops != 1:
            return "killed by signal 9" if self.stops else None
        self.polls_of_next += 1
        if self.polls_of_next == 1:
            return "killed by signal 9"
        if self.polls_of_next < 4:
            return None
        write_state(self.place, State("done", 2))
        return ""

    def stop(self, handles: Sequence[Any]) -> None:
        self.stops += 1


@pytest.mark.timeout(30)
def test_the_worker_after_one_that_hung_has_all_the_time(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_sweep, "STALLED_SECONDS", 0.5)
    engine = Again(place)
    spec = Spec(SPEC.jobs, SPEC.resources, retries=1)
    assert run_jobs(place.parents[1], spec, engine, Progress())["j"] == State("done", 2)
    assert engine.stops == 1


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


class EndsAtOnce(TakenByAnother):
    """An engine whose workers end before they write anything."""

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        self.submissions += 1
        assert self.submissions < 9
        return list(folders)

    def poll(self, handle: Any) -> str | None:
        return "the worker was killed by signal 9"


@pytest.mark.timeout(30)
@pytest.mark.parametrize("before", [State(), State("running", 1, "here:1"), State("failed", 1, "here:1")])
def test_workers_that_end_before_they_write_anything_are_tried_as_often_as_others(place: Path, before: State) -> None:
    engine = EndsAtOnce(place)
    write_state(place, before)
    spec = Spec(SPEC.jobs, SPEC.resources, retries=2)
    state = run_jobs(place.parents[1], spec, engine, Progress())["j"]
    assert state.status == "failed" and state.is_final and state.attempts == 3
    assert engine.submissions == 3 - before.attempts
