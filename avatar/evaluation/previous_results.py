"""What an earlier evaluation of a run has left: kept where it is of the same avatar and the same frames, else removed."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from avatar.errors import UserError
from avatar.evaluation.pictures import clear_pictures
from avatar.evaluation.protocol import NAME, Protocol, builtin_protocols
from avatar.evaluation.results import FrameResult
from avatar.evaluation.tracking_source import FRAMES_FILE, TRACKED_FILE, Drive, parts
from avatar.evaluation.training_coverage import Conditions
from avatar.files.read import read_bytes, read_json, read_text

MAX_TABLE_BYTES = 2**28  # of a table of frames
# Of results.json: where these agree, figures by different protocols may stand side by side.
_IDENTITY = ("format", "data_hash", "image_size", "head_fingerprint", "step", "perceptual", "config", "shared_choices")
_NO_MATTER = ("threads",)  # of the versions: drawing a trained avatar differs by rounding alone


class EarlierResults(NamedTuple):
    """What is kept: entries of results.json by protocol, with their tables of frames in place."""

    entries: dict[str, Any]
    shown: str | None  # the protocol of worst.png and of the video, where it is among them


def read_earlier(folder: Path, facts: Mapping[str, Any], asked: Collection[str]) -> EarlierResults:
    """What RUN/eval holds by other protocols than those `asked` for, of the avatar and frames that `facts` describe."""
    try:
        earlier = read_json(folder / "results.json")
        if _identity(earlier) != _identity(json.loads(json.dumps(facts, allow_nan=False))):
            return EarlierResults({}, None)
        others = {
            name: entry for name, entry in earlier["protocols"].items() if name not in asked and NAME.fullmatch(name)
        }
        whole = {name: entry for name, entry in others.items() if _is_whole(folder / name, entry)}
        return EarlierResults(whole, earlier["shown"] if earlier["shown"] in whole else None)
    except (UserError, ValueError, KeyError, TypeError, AttributeError):  # none, or not of this program
        return EarlierResults({}, None)


def in_order(entries: Mapping[str, Any]) -> dict[str, Any]:
    """By protocol: those that come with the program as its table has them, then others."""
    known = [name for name in builtin_protocols() if name in entries]
    return {name: entries[name] for name in (*known, *(name for name in entries if name not in known))}


def read_frames(place: Path, entry: dict[str, Any]) -> dict[Drive, list[FrameResult]]:
    """The tables of frames in RUN/eval/PROTOCOL."""
    found: dict[Drive, list[FrameResult]] = {}
    for drive, part in parts(entry).items():
        rows = csv.DictReader(io.StringIO(read_text(place / part.table, MAX_TABLE_BYTES)))
        found[drive] = [
            FrameResult(
                int(row["frame"]),
                row["name"],
                {name: float(row[name]) for name in part.figures["means"]},
                Conditions(*(float(row[name]) for name in Conditions._fields)),
            )
            for row in rows
        ]
    return found


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
            (table.parent / TRACKED_FILE).unlink(missing_ok=True)
        except OSError as error:
            raise UserError(f"{table} cannot be removed ({error.strerror}); it is of another evaluation") from None
        with suppress(OSError):  # somebody else's file is in there
            table.parent.rmdir()
    return removed


def _identity(results: Mapping[str, Any]) -> dict[str, Any]:
    versions = {name: value for name, value in results["versions"].items() if name not in _NO_MATTER}
    return {"versions": versions, **{key: results[key] for key in _IDENTITY}}


def _is_whole(place: Path, entry: dict[str, Any]) -> bool:
    """Whether an entry can be read, and its tables of frames are those that it was written with."""
    hashes = [
        hashlib.sha256(read_bytes(place / part.table, MAX_TABLE_BYTES)).hexdigest() == part.figures["frames_sha256"]
        for part in parts(entry).values()
    ]
    return bool(protocol_of(place.name, entry)) and all(hashes) and bool(read_frames(place, entry))
