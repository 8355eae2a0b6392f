"""What a worker prints never holds it up."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from avatar.errors import UserError
from avatar.sweep import worker as workers
from avatar.sweep.engines import EngineOptions, LocalProcesses, make_engine
from avatar.sweep.output import BoundedLog, end_of, old_of
from avatar.sweep.spec import Job, Resources, Spec
from avatar.sweep.state import progress_mark, write_heartbeat
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
