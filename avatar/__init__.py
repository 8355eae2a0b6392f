"""Animatable 3D Gaussian head avatars from one tracked video."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from avatar.version import __version__

if TYPE_CHECKING:
    from avatar.runs.trained_avatar import TrainedAvatar

__all__ = ["__version__", "load"]

# After every operation torch's OpenMP threads wait for the next one in a busy loop, for milliseconds, on the cores that the
# splatter's own threads want; where anything else runs, that loop is what makes a step ten times slower. Torch's GNU
# OpenMP reads this once, when torch is loaded, so it has no effect on a program that has imported torch before.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")


def load(file: Path | str, head: Path | str | None = None) -> TrainedAvatar:
    """Open a trained avatar: a run folder, its avatar.safetensors, or a copy of that anywhere.

    `head` is the FLAME-format head model that it was trained with, a file or folder; None takes the one packed into the
    file, else the one that the run was trained with, where that still is, else the one at $AVATAR_HEAD. Raises UserError
    (`avatar.errors`) with what is wrong and what to do.
    """
    from avatar.runs.run import open_trained  # imports torch; `avatar --help` must not wait for it

    return open_trained(Path(file), None if head is None else Path(head))
