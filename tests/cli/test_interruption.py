"""Ctrl-C, closed pipes and missing memory end a command with a sentence, never with a stack trace."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from command_line import avatar
from waiting import until

from avatar.commands import doctor

pytestmark = pytest.mark.slow

# What the installed script does; `main` begins when the program has taken care of signals.
SCRIPT = """
import avatar.cli
real = avatar.cli.main
def main(**options):
    print("begun", flush=True)
    return real(**options)
avatar.cli.main = main
avatar.cli.run()
"""


# A library that reports by itself whatever comes out of the middle of its import, and goes on. It sleeps in short steps:
# a signal in the moment before a system call does not wake it, and is seen only when it returns.
BEGUN = '    print("begun", flush=True)\n'
SWALLOWING = f"""\
    import time, traceback
    try:
    {BEGUN}\
        for _ in range(6000):
            time.sleep(0.01)
    except BaseException:
        traceback.print_exc()
"""


def start(*arguments: str, script: str = SCRIPT) -> subprocess.Popen[str]:
    """`avatar ...` as a process of its own that has just begun to import what it needs."""
    process = subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # ignored in the background
    )
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    return process


@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.3, 0.6, 1.0, 1.5])
@pytest.mark.parametrize("command", [("compare", "a", "b"), ("doctor",), ("--help",)], ids=lambda words: words[0])
def test_ctrl_c_at_any_moment_gives_no_stack_trace(command: tuple[str, ...], delay: float) -> None:
    process = start(*command)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert "Traceback" not in errors and "Exception ignored" not in errors and "KeyboardInterrupt" not in errors
    if process.returncode == 130:
        assert errors.endswith("avatar: interrupted\n")
    else:  # it was done already, or in its last moments
        assert process.returncode in (0, 1, -signal.SIGINT)


def test_ctrl_c_while_libraries_are_imported_is_the_conventional_status() -> None:
    process = start("compare", "a", "b")
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output, errors) == (130, "", "avatar: interrupted\n")


def test_sigterm_leaves_nothing_half_written(tmp_path: Path) -> None:
    """What `docker stop` and a cluster send."""
    made = tmp_path / "film.mp4"
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, "demo-data", str(made), "--video", "--frames", "600", "--size", "128"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until(lambda: [path for path in tmp_path.iterdir() if "partial" in path.name], 60)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and errors.endswith("avatar: interrupted\n")
    assert [path.name for path in tmp_path.iterdir()] in ([], ["head_model"])


def test_ctrl_c_does_not_come_out_of_the_middle_of_an_import() -> None:
    process = start("doctor", script=SCRIPT.replace(BEGUN, SWALLOWING))
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output, errors) == (130, "", "avatar: interrupted\n")


def test_a_job_in_the_background_that_ignores_ctrl_c_goes_on() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, "--version"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    process.send_signal(signal.SIGINT)
    assert process.stderr is not None
    output, errors = process.stdout.read(), process.stderr.read()  # `communicate` forgets what readline has read ahead
    assert process.wait(60) == 0 and output.startswith("avatar ") and errors == ""


def test_a_reader_that_has_seen_enough_is_no_error_to_show() -> None:
    """`avatar doctor | head -1`."""
    process = start("doctor")
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait(60) == 1


def test_a_full_or_forbidden_disk_gets_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: object) -> int:
        raise PermissionError(13, "Permission denied", "/somewhere/file")

    monkeypatch.setattr(doctor, "run_doctor", refuse)
    assert avatar("doctor", status=1) == "avatar: /somewhere/file: Permission denied\n"


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError(
            "[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 17179869184 bytes"
        ),
    ],
)
def test_memory_that_runs_out_gets_a_sentence(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def refuse(_: object) -> int:
        raise error

    monkeypatch.setattr(doctor, "run_doctor", refuse)
    output = avatar("doctor", status=1)
    assert output.startswith("avatar: there is not enough memory (") and output.count("\n") == 1


def test_a_full_gpu_gets_a_sentence_that_says_what_to_lower(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: object) -> int:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")

    monkeypatch.setattr(doctor, "run_doctor", refuse)
    output = avatar("doctor", status=1)
    assert (
        output.startswith("avatar: the GPU's memory is full: lower --size or model.uv_size") and output.count("\n") == 1
    )


def test_a_mistake_of_the_program_keeps_its_stack_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> int:
        raise RuntimeError("a tensor has the wrong shape")

    monkeypatch.setattr(doctor, "run_doctor", fail)
    with pytest.raises(RuntimeError, match="wrong shape"):
        avatar("doctor")


def test_the_installed_script_begins_where_ctrl_c_is_safe() -> None:
    script = Path(sys.executable).with_name("avatar" + (".exe" if os.name == "nt" else ""))
    if not script.is_file():
        pytest.skip("the program is not installed beside this interpreter")
    assert "from avatar.cli import run" in script.read_text(encoding="utf-8", errors="replace")
