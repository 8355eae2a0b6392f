"""One job: `avatar train`, resumed where it was stopped, then `avatar eval`. Running it again changes nothing.

Engines start it as a program, wherever they like: `avatar sweep-job FOLDER`.
What its commands say goes into FOLDER/log.txt, of bounded size. When it is killed, nothing of it lives on, and the next
one goes on.
"""

from __future__ import annotations

import os
import platform
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

from avatar.files.lock import locked
from avatar.runs.checkpoint import list_checkpoints
from avatar.sweep.output import BoundedLog, end_of, last_line, old_of
from avatar.sweep.spec import Job
from avatar.sweep.state import HEARTBEAT_SECONDS, State, read_job, read_state, write_heartbeat, write_state

OPTIONS = ("head", "tracking", "frame_offset", "data_format", "fps")  # of a source, as `avatar train` calls them
OK, EXIT_ERROR, EXIT_INTERRUPTED = 0, 1, 130
Command = Callable[[list[str]], int]  # `avatar WORDS`, its exit status


def run_job(folder: Path, command: Command) -> State:
    """Do a job, or what is left of it, and return what became of it.

    Whatever the job's commands do becomes a state. Raises UserError when another worker has the job.
    """
    job = read_job(folder)
    with locked(folder):
        before = read_state(folder)
        if before.status == "done" or before.is_final:
            return before
        begin = time.monotonic()
        worker = f"{platform.node()}:{os.getpid()}"
        running = State("running", before.attempts + 1, worker, seconds=before.seconds)
        write_state(folder, running)
        with heartbeat(folder):
            outcome = work(job, folder, command)
        seconds = before.seconds + time.monotonic() - begin
        # A worker that was wanted back has not failed; the attempt does not count.
        attempts = before.attempts if outcome.status == "waiting" else running.attempts
        state = replace(outcome, attempts=attempts, worker=worker, seconds=seconds)
        write_state(folder, state)
        return state


def work(job: Job, folder: Path, command: Command) -> State:
    run = folder / "run"
    train = ["train", *source_words(job), "--out", str(run)]
    train += ["--resume"] if list_checkpoints(run / "checkpoints") else list(job.overrides)
    evaluate = ["eval", str(run), *(word for name in job.protocols for word in ("--protocol", name))]
    for words in (train, evaluate):
        status, said = logged(command, words, folder / "log.txt")
        if status == EXIT_INTERRUPTED:
            return State("waiting")
        if status != OK:
            # A sentence is an answer, and would be given again. Everything else may go away.
            return State("failed", sentence=said, is_final=status == EXIT_ERROR)
    return State("done")


def source_words(job: Job) -> list[str]:
    words = [str(job.source["folder"])]
    for key in OPTIONS:
        if key in job.source:
            words += [f"--{key.replace('_', '-')}", str(job.source[key])]
    return words


def logged(command: Command, words: list[str], log: Path) -> tuple[int, str]:
    """Run a command, all that it says going into `log`; its exit status and the last line that it said."""
    with BoundedLog(log) as file:
        file.write(f"$ avatar {' '.join(words)}\n")
        with redirect_stdout(file), redirect_stderr(file):
            try:
                status = command(words)
            except SystemExit as stop:  # usage
                status = EXIT_ERROR if stop.code else OK
            except Exception:
                traceback.print_exc()
                status = -1
    return status, last_line(end_of(old_of(log)) + end_of(log))


def computed() -> int:
    """Seconds of processor time of this process and of those that it has waited for."""
    return int(sum(os.times()[:4]))


@contextmanager
def heartbeat(folder: Path) -> Iterator[None]:
    """Says every few seconds that the worker lives and how much it has computed, until the block ends."""
    ended = threading.Event()

    def keep_writing() -> None:
        while not ended.wait(HEARTBEAT_SECONDS):
            write_heartbeat(folder, computed())

    write_heartbeat(folder, computed())
    thread = threading.Thread(target=keep_writing, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
