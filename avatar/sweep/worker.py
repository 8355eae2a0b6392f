"""A job's worker: a process of its own, whose output is always read, so that it never waits for a reader."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

from avatar.sweep.output import BoundedLog, last_line

OUTPUT_FILE = "output.txt"
GRACE_SECONDS = 60.0  # between asking a worker to save its state and ending it
_KEPT = 4096  # bytes of its last words


class Worker:
    """Does the job of `folder`. What libraries print, past Python, goes into FOLDER/output.txt, of bounded size.

    gpus   those that it may use, as CUDA_VISIBLE_DEVICES names them; None: as this process
    """

    def __init__(self, folder: Path, threads: int, gpus: str | None = None) -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "AVATAR_THREADS": str(threads)}
        if gpus is not None:
            environment["CUDA_VISIBLE_DEVICES"] = gpus
        words = [sys.executable, "-m", "avatar.cli", "sweep-job", str(folder)]
        self._folder = folder
        self._process = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        self._end = b""
        self._reader = threading.Thread(target=self._read, daemon=True, name=f"output of {folder.name}")
        self._reader.start()

    def poll(self) -> str | None:
        """None while it runs; then why it ended, empty when it ended as it should."""
        if (status := self._process.poll()) is None:
            return None
        self._reader.join(1.0)  # a process that it has left behind may hold its output open
        return reason_of_end(status, self._end)

    def wait(self) -> str:
        """`poll`, when it has ended."""
        self._process.wait()
        return self.poll() or ""

    def ask_to_end(self) -> None:
        """Training saves its state then."""
        self._process.terminate()

    def end(self) -> None:
        """Wait for a worker that was asked to end, and end it where it does not."""
        try:
            self._process.wait(GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _read(self) -> None:
        assert self._process.stdout is not None
        log: BoundedLog | None = None
        with self._process.stdout as stream:
            while chunk := os.read(stream.fileno(), 2**16):
                self._end = (self._end + chunk)[-_KEPT:]
                with suppress(OSError):  # a full disk is no reason to let the worker wait
                    log = log or BoundedLog(self._folder / OUTPUT_FILE)
                    log.write_bytes(chunk)
        if log is not None:
            log.close()


def work_until_done(folder: str, threads: int) -> str:
    """A worker, waited for, as schedulers call it on another machine; its last words, empty when all went well.

    An interruption of this process is passed on, so that the training saves its state.
    """
    worker = Worker(Path(folder), threads)
    try:
        return worker.wait()
    except BaseException:
        worker.ask_to_end()
        worker.end()
        raise


def reason_of_end(status: int, said: bytes) -> str:
    """Why a worker ended, empty when it ended as it should."""
    if status == 0:
        return ""
    if status < 0:
        return f"the worker was killed by signal {-status}"
    return last_line(said) or f"the worker ended with status {status}"
