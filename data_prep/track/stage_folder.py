"""A folder that is made in stages, each of them whole or not at all, so that an interrupted run goes on where it was.

While it grows the folder is called `.NAME.partial` and lies beside its place. A stage writes into a folder of its own that
gets its name when it is complete, together with a hash of everything that it was made from; a stage with the same hash is
not made again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from avatar.errors import UserError
from avatar.files.atomic import refuse_current
from avatar.files.lock import LOCK_FILE, locked
from avatar.files.names import shortened
from avatar.files.read import read_json

RECORD = ".stage.json"
_MAX_RECORD = 2**24

Made = tuple[dict[str, Any], str]  # what a stage found out, and the hash of what it was made from


class StageFolder:
    """`run` the stages in order, then `finish`."""

    def __init__(self, growing: Path) -> None:
        self.path = growing

    def run(self, name: str, inputs: Mapping[str, Any], make: Callable[[Path], dict[str, Any]]) -> Made:
        """What `make` returned when it wrote the stage's files into the folder that it is given; now, or earlier.

        `inputs` and the result must be JSON. Raises UserError when the disk refuses.
        """
        key = hash_of([name, dict(inputs)])
        place = self.path / name
        known = _read_record(place / RECORD)
        if known is not None and known.get("key") == key:
            return known["result"], key
        partial = self.path / f"{name}.partial"
        with writing(place):
            for stale in (place, partial):
                shutil.rmtree(stale, ignore_errors=True)
            partial.mkdir(parents=True)
            result = json.loads(json.dumps(make(partial), allow_nan=False))
            (partial / RECORD).write_text(json.dumps({"key": key, "result": result}, allow_nan=False), encoding="utf-8")
            partial.rename(place)
        return result, key

    def finish(
        self,
        target: Path,
        temporary: tuple[str, ...],
        better: Mapping[str, str] | None = None,
        seal: Callable[[Path], object] = lambda _: None,
    ) -> None:
        """Remove what only the making needed, put each stage of `better` in the place of the one that it is named with,
        call `seal`, and give the folder its name."""
        try:
            for name in temporary:
                shutil.rmtree(self.path / name, ignore_errors=True)
            for name, other in (better or {}).items():
                shutil.rmtree(self.path / other)
                (self.path / name).rename(self.path / other)
            for record in self.path.rglob(RECORD):
                record.unlink()
            seal(self.path)
            self.path.rename(target)
            (target / LOCK_FILE).unlink(missing_ok=True)  # not before: another process would begin
        except OSError as error:
            raise UserError(
                f"{target} cannot be written ({error.strerror or error}); the same command tries again"
            ) from None


@contextlib.contextmanager
def growing(target: Path) -> Iterator[StageFolder]:
    """The stages of `target`, for one process at a time. Raises UserError where nothing can be written."""
    refuse_current(target)
    folder = target.with_name(f".{shortened(target.name)}.partial")
    with locked(folder):
        try:
            yield StageFolder(folder)
        except BaseException:
            for unfinished in (*folder.rglob("*.partial"), folder):
                if next(unfinished.rglob(RECORD), None) is None:  # there is nothing to go on from
                    shutil.rmtree(unfinished, ignore_errors=True)
            raise


@contextlib.contextmanager
def writing(place: Path) -> Iterator[None]:
    """Raises UserError when the disk refuses."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{place} cannot be written ({error.strerror or error}); free some space, or choose another --out"
        ) from None


def hash_of(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True, allow_nan=False).encode()).hexdigest()


def _read_record(path: Path) -> dict[str, Any] | None:
    try:
        record = read_json(path, _MAX_RECORD)
    except UserError:
        return None
    return record if isinstance(record, dict) and isinstance(record.get("result"), dict) else None
