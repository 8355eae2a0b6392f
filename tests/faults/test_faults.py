"""Every writer, stopped at every one of its steps: by a full disk, a disk that refuses, and by kill -9.

A writer runs in a child process in which the k-th call that changes files fails (or ends the process there), for every k
until the writer gets through. After each, what was there before is there whole, or the new one is.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tracked_folder import write_tracked_folder

from avatar.checkpoint import (
    Checkpoint,
    load_checkpoint,
    newest_checkpoint,
    read_run_info,
    save_checkpoint,
    write_atomically,
    write_run_info,
)
from avatar.data.subject import Subject
from avatar.data_prep.prepare import prepare
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.video import write_video

DONE, REFUSED, KILLED, BROKEN = 0, 3, 9, 4
STEPS = (
    "open",
    "os.rename",
    "os.mkdir",
    "os.remove",
    "os.rmdir",
    "os.chmod",
)  # audit events of calls that change files
FULL, READ_ONLY = errno.ENOSPC, errno.EROFS


def outcome(work: Callable[[], object], step: int, fault: int | None) -> int:
    """Exit status of a child that does `work` and meets the fault (None: its death) at the given step."""
    child = os.fork()
    if child == 0:
        left = step

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal left
            if event not in STEPS:
                return
            if event == "open" and not (
                isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            ):
                return
            left -= 1
            if left == 0 and fault is None:
                os._exit(KILLED)
            if left == 0:
                raise OSError(fault, os.strerror(fault or 0))

        status = BROKEN
        try:
            sys.addaudithook(hook)
            work()
            status = DONE
        except UserError:
            status = REFUSED
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def stop_at_every_step(work: Callable[[], object], fault: int | None, is_whole: Callable[[], object]) -> int:
    """The number of steps at which the writer was stopped; `is_whole` raises when something is lost."""
    stopped = 0
    for step in range(1, 200):
        status = outcome(work, step, fault)
        assert status in (DONE, REFUSED, KILLED), f"step {step} ends with a stack trace"
        is_whole()
        if status != DONE:
            stopped += 1
        elif fault is None:
            return stopped  # it went through without meeting the step
        elif step > stopped + 20:
            return stopped  # what fails after the result is in place, such as tidying up, may be passed over
    raise AssertionError("the writer never gets through")


def checkpoint(step: int) -> Checkpoint:
    return Checkpoint(step, {"model.a": torch.full((50, 3), float(step))}, {})


FAULTS = pytest.mark.parametrize("fault", [None, FULL, READ_ONLY], ids=["killed", "disk full", "read-only"])


@FAULTS
def test_checkpoints(fault: int | None, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "checkpoints", checkpoint(1), keep=1)

    def is_whole() -> None:
        newest = newest_checkpoint(tmp_path)
        assert newest.step in (1, 2) and bool((newest.tensors["model.a"] == newest.step).all())

    work = lambda: save_checkpoint(tmp_path / "checkpoints", checkpoint(2), keep=1)  # noqa: E731
    assert stop_at_every_step(work, fault, is_whole) >= 2
    save_checkpoint(tmp_path / "checkpoints", checkpoint(3), keep=1)
    assert load_checkpoint(tmp_path / "checkpoints" / "step_00000003.safetensors").step == 3


@FAULTS
def test_run_json(fault: int | None, tmp_path: Path) -> None:
    write_run_info(tmp_path, {"name": "old"})
    work = lambda: write_run_info(tmp_path, {"name": "new"})  # noqa: E731
    assert stop_at_every_step(work, fault, lambda: read_run_info(tmp_path)["name"] in ("old", "new") or 1 / 0) >= 2
    write_run_info(tmp_path, {"name": "newest"})
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"], "what a killed writer left is written over"


@FAULTS
def test_results(fault: int | None, tmp_path: Path) -> None:
    file = tmp_path / "eval" / "results.json"
    write_atomically(file, b"old" * 1000)
    work = lambda: write_atomically(file, b"new" * 1000)  # noqa: E731
    assert stop_at_every_step(work, fault, lambda: file.read_bytes() in (b"old" * 1000, b"new" * 1000) or 1 / 0) >= 2


def test_prepared_subjects_survive_a_kill(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", 6, 24, mouth_masks=False)
    head = load_head_assets(folder / "head_model")
    torch.set_num_threads(1)

    def work(offset: int = 1) -> None:
        prepare(folder, head, folder / "head_model", frame_offset=offset, out=tmp_path / "out", say=lambda _: None)

    work(0)

    def is_whole() -> None:
        if (tmp_path / "out").exists():
            subject = Subject.open(tmp_path / "out")
            assert subject.frame(len(subject) - 1).mouth_mask.max() > 0

    assert stop_at_every_step(work, None, is_whole) >= 3
    work()
    assert Subject.open(tmp_path / "out").manifest.frame_offset == 1


def test_videos_survive_a_kill(tmp_path: Path) -> None:
    file = tmp_path / "clip.mp4"
    pictures = [np.full((16, 16, 3), 40 * i, np.uint8) for i in range(3)]
    write_video(file, pictures, 25.0)
    old = file.read_bytes()

    def is_whole() -> None:
        data = file.read_bytes()
        assert data == old or (data[4:8] == b"ftyp" and b"moov" in data)

    stop_at_every_step(lambda: write_video(file, pictures, 25.0), None, is_whole)
