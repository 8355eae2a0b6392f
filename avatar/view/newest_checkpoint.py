"""The newest avatar of a training that runs beside the viewer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from avatar.errors import UserError
from avatar.files.lock import is_held
from avatar.runs.trained_avatar import TrainedAvatar


class NewestAvatar:
    """Made before the avatar is opened, so that nothing that is written meanwhile is missed."""

    def __init__(self, path: Path) -> None:
        """`path` is the avatar file, which training replaces at every checkpoint."""
        self._path, self._seen = path, _state(path)

    def poll(self, shown: TrainedAvatar, open_avatar: Callable[[], TrainedAvatar]) -> TrainedAvatar | None:
        """What is to be shown in the place of `shown`, once it is there: a file that cannot be opened, since not all of it
        is written or since it is damaged, is left until it changes, and so is one of another video."""
        if (state := _state(self._path)) == self._seen:
            return None
        self._seen = state
        with suppress(UserError):
            newer = open_avatar()
            if newer.step != shown.step and newer.recording.data_hash == shown.recording.data_hash:
                return newer
        return None


def progress(trained: TrainedAvatar, run: Path) -> str:
    """How far training is, for people."""
    last = trained.config.trainer.iterations
    state = "finished" if trained.step >= last else "training" if is_held(run) else "interrupted"
    return f"Step {trained.step:,} of {last:,}: {state}"


def _state(path: Path) -> tuple[int, ...]:
    """Another one once the file has changed."""
    try:
        status = path.stat()
    except OSError:
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns
