"""Where prepared subjects are kept, and from which inputs one was made."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from avatar.data.manifest import MANIFEST_VERSION
from avatar.files.environment import cache_folder
from avatar.files.names import display_name, safe_name
from data_prep.formats.frame_files import FrameFiles


def default_location(folder: Path, files: FrameFiles, options: dict[str, object]) -> Path:
    tracking = next(iter(files.tracking.values())).parent
    key = hashlib.sha256(json.dumps([str(folder), str(tracking), options], allow_nan=False).encode()).hexdigest()[:12]
    return cache_folder() / "subjects" / f"{safe_name(display_name(folder))}-{key}"


def input_hash(files: FrameFiles, options: Mapping[str, object]) -> str:
    digest = hashlib.sha256(json.dumps([MANIFEST_VERSION, str(files.folder), dict(options)], allow_nan=False).encode())
    for kind, found in files.of_kind().items():
        for number, path in found.items():
            digest.update(f"{kind} {number} {path} {_stamp(path)}\n".encode(errors="surrogateescape"))
    for path in files.listings:
        digest.update(f"{path} {_stamp(path)}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _stamp(path: Path) -> str:
    """Size and time, by which a change is noticed; a file that is named but not there is noticed when it comes."""
    try:
        status = path.stat()
    except OSError:
        return "missing"
    return f"{status.st_size} {status.st_mtime_ns}"
