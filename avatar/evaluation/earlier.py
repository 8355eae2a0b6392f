"""What an earlier evaluation of a run has left: kept where it is of the same avatar and the same frames, else removed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from avatar.errors import UserError
from avatar.evaluation.pictures import clear_pictures
from avatar.evaluation.protocol import Protocol

FRAMES_FILE = "frames.csv"
# Of results.json: where these agree, figures by different protocols may stand side by side.
_IDENTITY = ("format", "data_hash", "image_size", "head_fingerprint", "step", "config", "shared_choices")
_NO_MATTER = ("threads",)  # of the versions: the figures are the same to rounding


def earlier_results(folder: Path, results: Mapping[str, Any]) -> dict[str, Any]:
    """Entries by other protocols that RUN/eval holds of what `results` are about, with their tables of frames in place."""
    try:
        earlier = json.loads((folder / "results.json").read_bytes())
        if _identity(earlier) != _identity(json.loads(json.dumps(results))):
            return {}
        asked = {*results["protocols"], *results["left_out"]}
        others = {name: entry for name, entry in earlier["protocols"].items() if name not in asked}
        return {name: entry for name, entry in others.items() if _is_whole(folder / name, entry)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):  # none, or not of this program
        return {}


def protocol_of(name: str, entry: Mapping[str, Any]) -> Protocol:
    """The protocol that an entry of results.json was measured by. Raises TypeError or KeyError for a damaged entry."""
    choices = entry["choices"]
    lists = {key: tuple(choices[key]) for key in ("background", "regions")}
    return Protocol(**{"name": name, **choices, **lists})


def remove_others(folder: Path, kept: Collection[str]) -> list[str]:
    """Remove from RUN/eval the figures and pictures of every protocol that is not kept; their names.

    Only what an evaluation writes is removed.
    """
    removed = []
    for table in sorted(folder.glob(f"*/{FRAMES_FILE}")):
        if table.parent.name in kept:
            continue
        removed.append(table.parent.name)
        clear_pictures(table.parent)
        try:
            table.unlink()
        except OSError as error:
            raise UserError(f"{table} cannot be removed ({error.strerror}); it is of another evaluation") from None
        with suppress(OSError):  # somebody else's file is in there
            table.parent.rmdir()
    return removed


def _identity(results: Mapping[str, Any]) -> dict[str, Any]:
    versions = {name: value for name, value in results["versions"].items() if name not in _NO_MATTER}
    return {"versions": versions, **{key: results[key] for key in _IDENTITY}}


def _is_whole(place: Path, entry: Mapping[str, Any]) -> bool:
    """Whether an entry can be read, and its table of frames is the one that it was written with."""
    table = (place / FRAMES_FILE).read_bytes()
    return bool(protocol_of(place.name, entry)) and hashlib.sha256(table).hexdigest() == entry["frames_sha256"]
