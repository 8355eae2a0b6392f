"""What people give where a tracked folder is wanted, and what to give instead."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from avatar.data.manifest import MANIFEST_FILE, TRACKS_FILE
from avatar.data.read_image import IMAGE_SUFFIXES, OTHER_PICTURES
from avatar.data.source import MAX_FPS, Source
from avatar.errors import UserError
from avatar.files.names import typed
from avatar.head.find_head_model import candidates
from data_prep.formats import avatar_track, nersemble, nha
from data_prep.formats.transforms import read_json

_PARTS = ("imgs", "images", "image", "frames", "alpha", "parsing", "checkpoint", "flame_param")  # of tracked folders
_LISTINGS = ("transforms*.json", "flame_params.json", "*/flame_params.json")
_RUN_FILE = "run.json"
_SHOWN = 4  # folders in a sentence


def check_folder(folder: Path) -> None:
    """Raises UserError, with what to give instead, for what is clearly no tracked folder."""
    if folder.is_file():
        raise UserError(f"{folder} is a file; if it is a video, avatar track makes a tracked folder of it")
    if not folder.exists():
        raise UserError(f"{folder} does not exist")
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder; give the tracked video folder (docs/data.md)")
    if (folder / _RUN_FILE).is_file():
        source = _value(folder / _RUN_FILE, lambda raw: raw["source"]["folder"])
        raise UserError(f"{folder} is a run of avatar train; give the folder that it was trained on{source}")
    if (folder / MANIFEST_FILE).is_file() and (folder / TRACKS_FILE).is_file():
        source = _value(folder / MANIFEST_FILE, lambda raw: raw["source"])
        raise UserError(f"{folder} is a prepared subject; give the tracked folder that it was made from{source}")
    person = next((place for place in folder.resolve().parents[:2] if nersemble.recognise(place)), None)
    if person is not None and folder.resolve().is_relative_to(person / nersemble.SEQUENCES):
        raise UserError(f"{folder} is a part of {person}, whose calibration belongs to it; give {person}")
    if _looks_tracked(folder):
        return
    inside = sorted(path for path in folder.iterdir() if path.is_dir() and _looks_tracked(path))
    if inside:
        names = [f"{path.name}/" for path in inside[:_SHOWN]]
        more = f" and {len(inside) - _SHOWN} more" if len(inside) > _SHOWN else ""
        listed = " and ".join(", ".join(names).rsplit(", ", 1)) if not more else ", ".join(names) + more
        one = "it" if len(inside) == 1 else "one of them"
        raise UserError(f"{folder} is no tracked folder: it holds {listed}; give {one}")
    if any(path.suffix.lower() in (*IMAGE_SUFFIXES, *OTHER_PICTURES) for path in folder.iterdir()):
        raise UserError(
            f"{folder} holds pictures and no tracking; avatar track {typed(folder)} makes a tracked folder of them"
        )
    if candidates(folder):
        raise UserError(f"{folder} is a head model; give the tracked folder, and this one with --head")
    if next(folder.iterdir(), None) is None:
        raise UserError(f"{folder} is empty; docs/data.md says what belongs to a tracked folder")
    raise UserError(f"{folder} holds nothing that belongs to a tracked folder; docs/data.md says what does")


def check_numbers(source: Source) -> None:
    """Raises UserError for an --fps or a --max-left-out that no clip has."""
    if source.fps is not None and not 0 < source.fps <= MAX_FPS:  # a NaN is refused too
        raise UserError(f"--fps must be above 0 and at most {MAX_FPS:g}, not {source.fps:g}")
    if not 0 <= source.max_left_out <= 1:
        raise UserError(f"--max-left-out must be from 0 to 1, not {source.max_left_out:g}")


def _looks_tracked(folder: Path) -> bool:
    has_part = any((folder / name).is_dir() for name in _PARTS)
    has_layout = any(layout.recognise(folder) for layout in (avatar_track, nersemble, nha))
    return has_part or has_layout or any(next(folder.glob(name), None) for name in _LISTINGS)


def _value(file: Path, get: Callable[[Any], Any]) -> str:
    """`, NAME` where the file says it."""
    try:
        return f", {get(read_json(file))}"
    except (UserError, KeyError, TypeError):
        return ""
