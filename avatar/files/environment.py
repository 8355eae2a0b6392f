"""Folders outside of what a command is given: those that environment variables name, and the cache."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from avatar.errors import UserError

CACHE_VARIABLE = "AVATAR_CACHE"


def expanded(text: str, named: str) -> Path:
    """A path with `~` expanded. Raises UserError, which begins with `named`, for a home folder that the system does not
    know."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise UserError(f"{named} is in a home folder that this system does not know: give the whole path") from None


def named_path(variable: str) -> Path | None:
    """The path that an environment variable holds; None where it is empty or not set. Raises UserError as `expanded`."""
    text = os.environ.get(variable)
    return expanded(text, f"{variable}={text}") if text else None


def cache_folder() -> Path:
    """Where prepared subjects, models and weights are kept: $AVATAR_CACHE, else ~/.cache/avatar; for a user without a home
    folder, as in many containers, a folder among the temporary files.

    Raises UserError where that folder is somebody else's.
    """
    if (named := named_path(CACHE_VARIABLE)) is not None:
        return named
    try:
        return Path.home() / ".cache" / "avatar"
    except RuntimeError:  # no HOME, and no entry in the list of users
        user = os.getuid()
    folder = Path(tempfile.gettempdir()) / f"avatar-{user}"
    if folder.is_symlink() or (folder.exists() and folder.stat().st_uid != user):
        raise UserError(f"{folder} belongs to another user: set {CACHE_VARIABLE} to a folder of your own")
    return folder
