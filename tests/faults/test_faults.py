"""Every writer, stopped at every one of its steps: by a full disk, a disk that refuses, and by kill -9.

A writer runs in a child process in which the k-th call that changes files fails and all later ones do (or which ends
there), for every k until the writer gets through. A disk that fills up in the middle of a write is a limit on the size of
files: then the write itself is cut short, also in the video encoder, a process of its own. After each, what was there
before is there whole, or the new one is.
"""

from __future__ import annotations

import errno
import os
import resource
import shutil
import sys
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import run_info, train_small
from tracked_folder import write_tracked_folder

from avatar.commands.arguments import parse
from avatar.commands.eval import run_eval
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files import atomic
from avatar.files.atomic import write_atomically
from avatar.files.video import write_video
from avatar.head.assets import load_head_assets
from avatar.runs.checkpoint import (
    Checkpoint,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
)
from avatar.runs.run import read_run_info, write_run_info
from data_prep.prepare.prepare import prepare

pytestmark = pytest.mark.slow

DONE, REFUSED, KILLED, BROKEN = 0, 3, 9, 4
# Audit events of calls that change files.
STEPS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.chmod")
FREES = ("os.remove", "os.rmdir")  # goes on a full disk
FULL, READ_ONLY = errno.ENOSPC, errno.EROFS


def outcome(work: Callable[[], object], prepare_child: Callable[[], object]) -> int:
    """Exit status of a child that does `work` after `prepare_child`."""
    child = os.fork()
    if child == 0:
        status = BROKEN
        try:
            prepare_child()
            work()
            status = DONE
        except UserError:
            status = REFUSED
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def fail_from(step: int, fault: int | None) -> None:
    """From the given step on, calls of this process that change files raise the fault (None: the process ends)."""
    left = step

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal left
        if event not in STEPS or (fault == FULL and event in FREES):
            return
        if event == "open" and not (
            isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        ):
            return
        left -= 1
        if left <= 0 and fault is None:
            os._exit(KILLED)
        if left <= 0:
            raise OSError(fault, os.strerror(fault or 0))

    sys.addaudithook(hook)


def stop_at_every_step(work: Callable[[], object], fault: int | None, is_whole: Callable[[], object]) -> int:
    """The number of steps at which the writer was stopped; `is_whole` raises when something is lost."""
    stopped = 0
    for step in range(1, 200):
        status = outcome(work, lambda: fail_from(step, fault))  # noqa: B023 (called at once)
        assert status in (DONE, REFUSED, KILLED), f"step {step} ends with a stack trace"
        is_whole()
        if status != DONE:
            stopped += 1
        elif fault is None or step > stopped + 10:
            return stopped  # what fails after the result is in place, such as tidying up, may be passed over
    raise AssertionError("the writer never gets through")


def fill_up(work: Callable[[], object], sizes: Iterable[int], is_whole: Callable[[], object]) -> int:
    """The number of sizes (bytes that a file can have) at which `work` was refused, `is_whole` holding after each."""
    refused = 0
    for size in sizes:
        status = outcome(work, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)))  # noqa: B023
        assert status in (DONE, REFUSED), f"with {size} bytes it ends with a stack trace"
        is_whole()
        refused += status == REFUSED
    return refused


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
    if fault == FULL:
        assert fill_up(work, (0, 1, 500), is_whole) == 3
    save_checkpoint(tmp_path / "checkpoints", checkpoint(3), keep=1)
    assert load_checkpoint(tmp_path / "checkpoints" / "step_00000003.safetensors").step == 3


@FAULTS
def test_run_json(fault: int | None, tmp_path: Path) -> None:
    write_run_info(tmp_path, run_info("old"))
    work = lambda: write_run_info(tmp_path, run_info("new"))  # noqa: E731
    assert stop_at_every_step(work, fault, lambda: read_run_info(tmp_path).perceptual in ("old", "new") or 1 / 0) >= 2
    atomic._CLEANED.clear()  # as in a new process
    write_run_info(tmp_path, run_info("newest"))
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"], "what a killed writer left is removed"


@FAULTS
def test_results(fault: int | None, tmp_path: Path) -> None:
    file = tmp_path / "eval" / "results.json"
    write_atomically(file, b"old" * 1000)
    work = lambda: write_atomically(file, b"new" * 1000)  # noqa: E731
    assert stop_at_every_step(work, fault, lambda: file.read_bytes() in (b"old" * 1000, b"new" * 1000) or 1 / 0) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("fault", [FULL, READ_ONLY], ids=["disk full", "read-only"])
def test_evaluations(fault: int, tracked_folder: Path, tmp_path: Path) -> None:
    """What an evaluation could not write, it says in one sentence; the figures before are there still."""
    run = tmp_path / "run"
    train_small(tracked_folder, run, ["trainer.iterations=2"])
    words = ["eval", str(run), "--protocol", "strict", "--frames"]
    torch.set_num_threads(1)
    run_eval(parse(words))
    figures = (run / "eval" / "results.json").read_bytes()
    for step in (1, 10, 60):
        assert outcome(lambda: run_eval(parse(words)), lambda: fail_from(step, fault)) == REFUSED  # noqa: B023
        assert (run / "eval" / "results.json").read_bytes() == figures


@pytest.mark.slow
@FAULTS
def test_prepared_subjects(fault: int | None, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", 4, 24, mouth_masks=False)
    head = load_head_assets(folder / "head_model")
    torch.set_num_threads(1)
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / "prepared"

    def work(offset: int = 1) -> None:
        source = Source(folder, folder / "head_model", frame_offset=offset)
        prepare(source, head, out=target, say=lambda _: None)

    work(0)

    def is_whole() -> None:
        if not target.exists():  # stopped between the two renames: the old one lies beside it
            assert len(list((tmp_path / "out").glob(".prepared-old-*/old/manifest.json"))) == 1
            work(0)
        subject = Subject.open(target)
        assert subject.manifest.frame_offset in (0, 1)
        assert all(subject.frame(i).mouth_mask.max() > 0 for i in range(len(subject)))
        if subject.manifest.frame_offset == 1:  # the next step is to meet a writer that has something to do
            work(0)
        for left in (tmp_path / "out").glob(".*"):
            shutil.rmtree(left)

    assert stop_at_every_step(work, fault, is_whole) >= 8
    if fault == FULL:
        assert fill_up(work, (0, 60, 100, 1000), is_whole) == 4
    work()
    assert Subject.open(target).manifest.frame_offset == 1


@FAULTS
def test_videos(fault: int | None, tmp_path: Path) -> None:
    file = tmp_path / "clip.mp4"
    noise = np.random.default_rng(0).integers(0, 255, (3, 64, 64, 3), np.uint8)
    write_video(file, noise[:2], 25.0)
    old = file.read_bytes()
    write_video(file, noise, 25.0)
    new = file.read_bytes()
    file.write_bytes(old)
    assert old != new

    def is_whole() -> None:
        assert file.read_bytes() in (old, new)
        file.write_bytes(old)
        if fault == FULL:
            assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]

    work = lambda: write_video(file, noise, 25.0)  # noqa: E731
    assert stop_at_every_step(work, fault, is_whole) >= 1
    sizes = (0, 100, len(new) // 2, len(new) - 600, len(new) - 1)
    if fault == FULL:
        assert fill_up(work, sizes, is_whole) == len(sizes)
