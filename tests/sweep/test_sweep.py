"""Three tiny jobs, one of them broken on purpose, one killed in the middle, on every engine: the same figures on each."""

from __future__ import annotations

import contextlib
import csv
import importlib.util
import io
import json
import os
import re
import shutil
import signal
import threading
import time
from pathlib import Path

import pytest
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.errors import UserError
from avatar.runs.checkpoint import list_checkpoints
from avatar.sweep.spec import Job, Resources, Spec
from avatar.sweep.state import State, read_state, read_sweep, write_state, write_sweep
from avatar.sweep.status import Progress, overview

ENGINES = {"local": "json", "ray": "ray", "slurm": "submitit"}
OPTIONS = {"local": (), "ray": (), "slurm": ("--address", "local")}
BROKEN = "data.test_frames=500"


def write_spec(folder: Path, name: str = "sweep.yaml", **changes: object) -> Path:
    content = {
        "subjects": [{"folder": "someone", "head": "someone/head_model", "frame_offset": 1}],
        "variants": [[], "model=flashavatar", BROKEN],
        "overrides": [*SMALL, "trainer.iterations=40", "trainer.checkpoint_every=2"],
        "protocols": ["strict"],
        "threads": 1,
        "memory_gb": 0.5,
        **changes,
    }
    path = folder / name
    path.write_text(json.dumps(content))  # JSON is YAML
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep")
    write_tracked_folder(folder / "someone", frames=12, size=32)
    return folder


def kill_first_worker_with_a_checkpoint(folder: Path, killed: list[str], sweep_ended: threading.Event) -> None:
    """SIGKILL to the worker of the first job that has saved something."""
    while not sweep_ended.is_set():
        for job in sorted((folder / "jobs").glob("*")):
            if list_checkpoints(job / "run" / "checkpoints"):
                state = read_state(job)
                if state.status == "running" and state.attempts == 1:
                    os.kill(int(state.worker.rpartition(":")[2]), signal.SIGKILL)
                    killed.append(job.name)
                    return
        time.sleep(0.005)


@pytest.fixture
def found_before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table of the engine that was first, for all workers of this run of tests."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "first_compare.csv"


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_sweep_on_every_engine(engine: str, place: Path, found_before: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec(ENGINES[engine]) is None:
        pytest.skip(f"{ENGINES[engine]} is not installed (extra [{engine}])")
    folder, killed, ended = tmp_path / "out", [], threading.Event()
    killer = threading.Thread(target=kill_first_worker_with_a_checkpoint, args=(folder, killed, ended), daemon=True)
    killer.start()
    options = ("--out", folder, "--engine", engine, "--workers", 2, *OPTIONS[engine])
    output = avatar("sweep", write_spec(place), *options, status=1)
    ended.set()
    killer.join()
    states = {path.name: read_state(path) for path in (folder / "jobs").iterdir()}
    assert len(states) == 3
    (broken,) = [name for name, state in states.items() if state.status == "failed"]
    assert "500 test frames cannot be held out of 12" in states[broken].sentence
    assert states[broken].is_final and states[broken].attempts == 1, "a sentence is an answer"
    assert [state.status for state in states.values()].count("done") == 2 and len(killed) == 1
    assert states[killed[0]].attempts == 2, "the job whose worker was killed went on in another"
    assert "Resuming" in (folder / "jobs" / killed[0] / "log.txt").read_text()
    assert "3 jobs: 2 done, 1 failed" in output and f"{BROKEN} is left out" in output
    # Figures hold no times: they are the same on every engine, killed or not.
    table = (folder / "compare.csv").read_text()
    rows = list(csv.DictReader(table.splitlines()))
    assert {row["run"] for row in rows if row["figure"] == "psnr"} >= {"default", "model=flashavatar"}
    with contextlib.suppress(FileExistsError):
        os.link(folder / "compare.csv", found_before)
    assert found_before.read_text() == table

    again = avatar("sweep", "--out", folder, status=1)  # on whichever engine
    after = {path.name: read_state(path).attempts for path in (folder / "jobs").iterdir()}
    assert after == {name: state.attempts for name, state in states.items()}, "nothing settled is done again"
    assert "2 done, 1 failed" in again


@pytest.mark.slow
def test_status_and_another_try(place: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    broken = write_spec(place, "broken.yaml", variants=[BROKEN])
    assert "holds no sweep; start one with" in avatar("sweep", broken, "--out", folder, "--status", status=1)
    assert "No table" in avatar("sweep", broken, "--out", folder, "--workers", 1, status=1)
    shown = avatar("sweep", "--out", folder, "--status", status=1)
    assert "1 jobs: 0 done, 1 failed" in shown and shown.count("500 test frames cannot be held") == 2
    (job,) = (folder / "jobs").iterdir()
    assert read_state(job).is_final
    write_state(job, State("failed", 1, sentence="x", is_final=True))
    avatar("sweep", "--out", folder, "--retry-failed", status=1)
    assert "500 test frames" in read_state(job).sentence

    another = write_spec(place, "another.yaml", variants=[BROKEN], protocols=["hypergaussians"])
    assert "holds a sweep in which" in avatar("sweep", another, "--out", folder, status=1)
    more = write_spec(place, "more.yaml", variants=[BROKEN], seeds=[0, 7])
    avatar("sweep", more, "--out", folder, "--workers", 1, status=1)
    assert len(list((folder / "jobs").iterdir())) == 2

    fewer = avatar("sweep", broken, "--out", folder, "--workers", 1, status=1)
    assert "Note: 1 jobs in" in fewer and "seed7, are not in" in fewer and "\n1 jobs on local" in fewer
    assert len(list((folder / "jobs").iterdir())) == 2
    assert "1 jobs: 0 done" in avatar("sweep", "--out", folder, "--status", status=1)
    assert "holds a sweep in which" in avatar("sweep", another, "--out", folder, status=1)
    assert "Note:" not in avatar("sweep", more, "--out", folder, "--workers", 1, status=1)


def test_a_sweep_that_is_refused_writes_no_job(tmp_path: Path) -> None:
    def spec(*words: str) -> Spec:
        common = {"subject": "a", "seed": 0, "source": {"folder": "a"}, "protocols": ()}
        named = (word.partition(":") for word in words)
        return Spec(
            tuple(Job(name, variant=name, overrides=(own,), **common) for name, _, own in named), Resources(), 2
        )

    write_sweep(tmp_path, spec("b:1"))
    with pytest.raises(UserError, match="in which b is something else"):
        write_sweep(tmp_path, spec("a:1", "b:2"))
    assert not write_sweep(tmp_path, spec("a:2", "b:1", "c:1")), "a was never in the sweep"
    assert read_sweep(tmp_path) == spec("a:2", "b:1", "c:1")

    for name in ("a", "c"):
        shutil.rmtree(tmp_path / "jobs" / name)
    assert write_sweep(tmp_path, spec("a:3", "b:1")) == ["c"], "whose folder a person deleted, as that of a"
    assert read_sweep(tmp_path) == spec("a:3", "b:1")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_says_when_all_will_be_over_and_rewrites_only_its_own_lines() -> None:
    states = {"a": State("done", 1, seconds=100), "b": State("done", 1, seconds=200), "c": State("running", 1)}
    states |= {"d": State(), "e": State("failed", 3, sentence="a sentence")}
    lines = overview(states)
    assert lines[0] == "5 jobs: 2 done, 1 running, 1 waiting, 1 failed"
    assert "takes 2 min 30 s" in lines[1] and "about 5 min 00 s with 1 at a time" in lines[1]
    assert "about 1 min 15 s with 4 at a time" in overview(states, 4)[1]
    assert [line.split()[:2] for line in lines[2:]] == [["running", "c"], ["failed", "e:"]]
    assert len(overview({})) == 1
    progress = Progress(out=(out := Terminal()))
    progress.show(states)
    assert re.findall(r"\x1b\[\d+A", out.getvalue()) == []
    progress.show(states)  # too soon to be drawn again
    progress.show(states, last=True)
    assert re.findall(r"\x1b\[\d+A", out.getvalue()) == ["\x1b[4A"]


def test_progress_is_cut_to_the_terminal_until_its_last_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """The cursor goes up by as many lines as were written, not by those that a terminal broke them into."""
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("LINES", "4")
    states = {f"job{n}": State("failed", 3, sentence="long" * 30) for n in range(9)}
    Progress(out=(out := Terminal())).show(states)
    lines = re.sub(r"\x1b\[\d*\w", "", out.getvalue()).splitlines()
    assert len(lines) == 3 and all(len(line) < 40 for line in lines)
    Progress(out=(out := Terminal())).show(states, last=True)
    assert out.getvalue().count("long" * 30) == 9


def test_a_worker_that_fell_silent_is_replaced(tmp_path: Path) -> None:
    write_state(tmp_path, State("running", 1, "elsewhere:1"))
    assert read_state(tmp_path).status == "waiting", "a running job without a heartbeat has no worker"
    (tmp_path / "heartbeat").touch()
    assert read_state(tmp_path).status == "running"
    os.utime(tmp_path / "heartbeat", (time.time() - 61, time.time() - 61))
    assert read_state(tmp_path).status == "waiting"
