"""The loop of a sweep: submit what waits, look what became of it, try again what may go better, show it."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from avatar.files.lock import is_held
from avatar.sweep.engines import Engine
from avatar.sweep.spec import Spec
from avatar.sweep.state import State, progress_mark, read_state, stored_state, write_state
from avatar.sweep.status import Progress, duration

POLL_SECONDS = 0.5
STALLED_SECONDS = 15 * 60.0  # in which a worker that computes anything has used a second of its processor


class StallTimer:
    """How long each job's worker has made no progress, by this machine's clock."""

    def __init__(self) -> None:
        self._marks: dict[Path, tuple[bytes, float]] = {}

    def begin(self, place: Path) -> None:
        """Forget the worker that had the job before."""
        self._marks.pop(place, None)

    def stalled_seconds(self, place: Path) -> float:
        now, mark = time.monotonic(), progress_mark(place)
        if place not in self._marks or self._marks[place][0] != mark:
            self._marks[place] = mark, now
        return now - self._marks[place][1]


def run_jobs(folder: Path, spec: Spec, engine: Engine, progress: Progress) -> dict[str, State]:
    """Run every job that is not done on the engine; returns what became of each.

    A job that fails never stops the others. One whose worker was killed or crashed is tried again up to `spec.retries`
    times; one that failed with a sentence is not. One whose worker hangs is ended, and counts as crashed. Ctrl-C asks the
    workers to save their state and ends.
    """
    places = {job.name: folder / "jobs" / job.name for job in spec.jobs}
    states = {name: read_state(place) for name, place in places.items()}
    handles: dict[str, Any] = {}
    submitted: dict[str, State] = {}  # what each job's state was then
    stalls, ended = StallTimer(), dict[str, str]()

    def submit(names: list[str]) -> None:
        if names:
            for name in names:
                submitted[name] = stored_state(places[name])
                stalls.begin(places[name])
            handles.update(zip(names, engine.submit([places[name] for name in names]), strict=True))

    elsewhere = {name for name, state in states.items() if state.status == "running"}
    submit([name for name, state in states.items() if name not in elsewhere and is_open(state, spec.retries)])
    try:
        while handles or elsewhere:
            again = []
            for name, handle in list(handles.items()):
                said = engine.poll(handle)
                if said is not None:
                    del handles[name]
                    final_state(places[name], submitted[name], ended.pop(name, said), spec.retries)
                    elsewhere.add(name)  # unless it is read below that nobody has it
                    continue
                states[name] = read_state(places[name])
                stored = stored_state(places[name])
                is_running = name not in ended and stored.status == "running" and stored != submitted[name]
                if is_running and stalls.stalled_seconds(places[name]) > STALLED_SECONDS:
                    ended[name] = f"the worker hung: no progress for {duration(STALLED_SECONDS)}"
                    engine.stop([handle])
            for name in list(elsewhere):  # another engine's worker has it, until it is done or falls silent
                states[name] = read_state(places[name])
                if states[name].status != "running":
                    elsewhere.remove(name)
                    again += [name] if is_open(states[name], spec.retries) else []
                elif stalls.stalled_seconds(places[name]) > STALLED_SECONDS:  # and only its own engine can end it
                    elsewhere.remove(name)
                    hangs = (
                        f"{states[name].worker} hangs: no progress for {duration(STALLED_SECONDS)}; end it, and go on"
                    )
                    states[name] = replace(states[name], status="failed", sentence=hangs)
            submit(again)
            progress.show(states)
            if handles or elsewhere:
                time.sleep(POLL_SECONDS)
    except BaseException:
        engine.stop(list(handles.values()))
        raise
    progress.show(states, last=True)
    return states


def is_open(state: State, retries: int) -> bool:
    """Whether there is something left to do, and to hope for."""
    if state.status == "done" or state.is_final:
        return False
    return state.status != "failed" or state.attempts <= retries


def final_state(place: Path, before: State, said: str, retries: int) -> State:
    """The state of a job whose worker has ended. One that died without a word leaves `running` behind, or what was there
    `before` it.

    A job that another sweep's worker has taken is running, and nothing is written.
    """
    state = stored_state(place)
    if "is being written by" in said and is_held(place):
        return replace(state, status="running")
    if state == before or (said and state.status == "waiting"):
        state = replace(state, status="running", attempts=state.attempts + 1)
    if state.status == "running":
        state = replace(state, status="failed", sentence=said or "the worker ended without a word")
    if state.status == "failed" and state.attempts > retries:
        state = replace(state, is_final=True)
    write_state(place, state)
    return state
