"""avatar train --view: the viewer beside a training, in a process of its own."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from avatar.errors import check_installed
from avatar.files.read import is_there
from avatar.pipeline import OK
from avatar.runs.avatar_file import AVATAR_FILE

POLL_SECONDS = 0.5


def train_in_view(run: Path, head: Path | None, train: Callable[[], int]) -> int:
    """The exit status of `train`. The viewer starts when the run holds an avatar, and ends when a person ends it after a
    training that ended well, else with the training."""
    check_installed("avatar train --view", "view", "viser")
    viewers: list[subprocess.Popen[bytes]] = []
    ended = threading.Event()
    words = [sys.executable, "-m", "avatar.cli", "view", str(run), "--port", "0"]

    def start() -> None:
        while not is_there(run / AVATAR_FILE):
            if ended.wait(POLL_SECONDS):
                break
        if is_there(run / AVATAR_FILE):
            viewers.append(subprocess.Popen([*words, *([] if head is None else ["--head", str(head)])]))

    starter = threading.Thread(target=start, daemon=True)
    starter.start()
    try:
        status = train()
        ended.set()
        starter.join()
        if status == OK and viewers:
            with suppress(KeyboardInterrupt):
                viewers[0].wait()
        return status
    finally:
        ended.set()
        starter.join()
        for viewer in viewers:
            viewer.terminate()
            viewer.wait()
