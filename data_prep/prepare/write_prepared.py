"""The prepared subject's folder: written beside its place and renamed, so that it is either whole or not there."""

from __future__ import annotations

import contextlib
import errno
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from safetensors.numpy import save

from avatar.data.manifest import MANIFEST_FILE, TRACKS_FILE, Manifest, read_manifest
from avatar.errors import UserError
from avatar.files.atomic import whole_folder
from avatar.files.names import safe_name
from data_prep.prepare.checksums import CONTENTS_FILE, find_damage, write_contents

HEAD_FOLDER, MOUTH_FOLDER = "head", "mouth"
_PARTS = {MANIFEST_FILE, TRACKS_FILE, CONTENTS_FILE, HEAD_FOLDER, MOUTH_FOLDER}
_THERE_IS_ANOTHER = errno.ENOENT, errno.EEXIST, errno.ENOTEMPTY  # or there was none to put back


def is_current(target: Path, input_hash: str, is_chosen: bool, say: Callable[[str], object] = lambda _: None) -> bool:
    """Whether `target` was prepared from these inputs and is whole; `say` hears where it is damaged.

    A chosen folder that is something else, or holds something else too, is never overwritten.
    """
    try:
        names = {path.name for path in target.iterdir()}
    except FileNotFoundError:
        return False
    except NotADirectoryError:
        names = {target.name} if target.exists() else set()
    is_prepared = MANIFEST_FILE in names and not names.isdisjoint({TRACKS_FILE, CONTENTS_FILE})
    if is_chosen and names and not is_prepared:
        raise UserError(f"{target} exists and is not a prepared subject; choose another --out")
    if is_chosen and (others := sorted(names - _PARTS)):
        raise UserError(
            f"{target} also holds {others[0]}, which is no part of a prepared subject; choose another --out"
        )
    if MANIFEST_FILE not in names:
        return False
    if (damage := find_damage(target)) is not None:
        say(f"the prepared subject {target} is damaged: {damage}; it is made again")
        return False
    try:
        return read_manifest(target).input_hash == input_hash
    except UserError:
        return False


def write_prepared(
    target: Path, manifest: Manifest, arrays: dict[str, np.ndarray], write_masks: Callable[[Path], None]
) -> None:
    """Write `target`; `write_masks` puts the derived masks into the folder that it is given.

    Raises UserError when the place cannot be written.
    """
    advice = "name another folder with --out, or another cache with AVATAR_CACHE"
    with whole_folder(target, lambda building, _: _replace(target, building, manifest.input_hash), advice) as building:
        (building / TRACKS_FILE).write_bytes(save(arrays))
        write_masks(building)
        (building / MANIFEST_FILE).write_text(manifest.to_json(), encoding="utf-8")
        write_contents(building)


def _replace(target: Path, building: Path, input_hash: str) -> None:
    """Rename `building` to `target`, moving away what is there; another process may be doing the same."""
    for attempt in range(100):
        try:
            building.rename(target)
            return
        except OSError:
            if attempt == 99:
                raise
            if not target.exists():
                continue  # moved away just now by another process
        if is_current(target, input_hash, is_chosen=False):
            return
        stale = Path(tempfile.mkdtemp(prefix=f".{safe_name(target.name)}-old-", dir=target.parent))
        try:
            with contextlib.suppress(FileNotFoundError):
                target.rename(stale / "old")
            building.rename(target)
        except OSError:
            try:
                (stale / "old").rename(target)
            except OSError as error:
                if error.errno not in _THERE_IS_ANOTHER:
                    raise
            shutil.rmtree(stale, ignore_errors=True)
        else:
            shutil.rmtree(stale, ignore_errors=True)
            return
