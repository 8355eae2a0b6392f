"""Drive files as CSV: the program's own columns, or ARKit's blendshapes as phone apps record them (Live Link Face)."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from avatar.errors import UserError
from avatar.files.opening import read_text
from avatar.head.expression_names import JAW_TARGETS, NAMES_FILE, ExpressionNames, plain

EYE_COLUMNS = tuple(f"{side}_eye_{axis}" for side in ("left", "right") for axis in "xyz")
EYELID_COLUMNS = ("eyelid_left", "eyelid_right")
MAX_BYTES = 2**27  # 50 minutes of ARKit at 60 frames a second
ARKIT_FPS = 60.0  # of Live Link Face, where the timecodes do not tell
# Where the head model does not say otherwise: what ARKit's 1 stands for. Rough means of what people can do; ARKit
# gives no angles with these blendshapes.
JAW_OPEN_RADIANS, GAZE_RADIANS = 0.35, 0.6
_POSE = re.compile(r"(head|lefteye|righteye)(yaw|pitch|roll)")
_TIMECODE = re.compile(r"(\d+):(\d+):(\d+):[\d.]+")


def read_drive_csv(
    path: Path, num_expressions: int, names: ExpressionNames, say: Callable[[str], None]
) -> dict[str, np.ndarray]:
    """A CSV's columns as the arrays of an .npz drive file. Raises UserError with the file, the line and the column."""
    header, rows = _read_rows(path)
    if plain(header[0]) == "timecode" or "jawopen" in map(plain, header):
        return _from_arkit(path, header, rows, num_expressions, names, say)
    return _from_columns(path, header, rows, num_expressions, names, say)


def _from_columns(
    path: Path,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    num_expressions: int,
    names: ExpressionNames,
    say: Callable[[str], None],
) -> dict[str, np.ndarray]:
    coefficients: dict[int, int] = {}  # coefficient -> column
    unread = []
    special = {
        name: header.index(name) for name in ("time", *JAW_TARGETS, *EYE_COLUMNS, *EYELID_COLUMNS) if name in header
    }
    for column, name in enumerate(header):
        numbered = re.fullmatch(r"expression_(\d{1,6})", name)
        index = int(numbered[1]) if numbered else names.index(name)
        if name in special:
            continue
        if index is None:
            unread.append(name)
        elif index >= num_expressions:
            raise UserError(f"{path}: the column {name} is beyond the head model's {num_expressions} coefficients")
        elif index in coefficients:
            raise UserError(f"{path}: the columns {header[coefficients[index]]} and {name} are the same coefficient")
        else:
            coefficients[index] = column
    if not coefficients:
        raise UserError(
            f"{path} has no column expression_0, expression_1, ... nor one of the head model's names; see docs/transfer.md"
        )
    if unread:
        say(f"Note: left unread in {path.name}: {_some(unread)}")
    expression = np.zeros((len(rows), max(coefficients) + 1))
    for index, column in coefficients.items():
        expression[:, index] = _column(path, header, rows, column)
    arrays = {"expression": expression}
    for key, columns in (("jaw", JAW_TARGETS), ("eyes", EYE_COLUMNS), ("eyelids", EYELID_COLUMNS)):
        given = [name for name in columns if name in special]
        if given and len(given) < len(columns):
            raise UserError(f"{path} has {given[0]} but not all of {', '.join(columns)}")
        if given:
            arrays[key] = np.stack([_column(path, header, rows, special[name]) for name in columns], axis=1)
    if "time" in special and len(rows) > 1:
        time = _column(path, header, rows, special["time"])
        if not (np.diff(time) > 0).all():
            raise UserError(f"{path}: the column time must rise from line to line (seconds)")
        arrays["fps"] = np.array((len(rows) - 1) / (time[-1] - time[0]))
    return arrays


def _from_arkit(
    path: Path,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    num_expressions: int,
    names: ExpressionNames,
    say: Callable[[str], None],
) -> dict[str, np.ndarray]:
    """ARKit's blendshapes: blinks become eyelids, the eyes' directions gaze, the rest coefficients of their names."""
    values = {
        plain(name): _column(path, header, rows, column)
        for column, name in enumerate(header)
        if plain(name) not in ("timecode", "blendshapecount")
    }
    pose = [name for name in values if _POSE.fullmatch(name)]
    arrays, unread = from_blendshapes(values, len(rows), num_expressions, names)
    unmapped = [next(own for own in header if plain(own) == name) for name in unread]
    if not arrays["expression"].any() and len(unmapped) > 1:
        raise UserError(
            f"{path} holds ARKit's blendshapes, and the head model does not say which of its expressions they are: put "
            f"{NAMES_FILE} beside the model file, with the name of each coefficient or ARKit's weights (docs/transfer.md)"
        )
    if unmapped:
        say(f"Note: {len(unmapped)} of ARKit's blendshapes move nothing on this head model: {_some(unmapped)}")
    if any(name.startswith("head") for name in pose):
        say(f"Note: the head's turns in {path.name} are not used; the avatar's own camera is shown")
    return arrays | {"fps": np.array(_timecode_fps([row[0] for row in rows]))}


def from_blendshapes(
    values: Mapping[str, np.ndarray], frames: int, num_expressions: int, names: ExpressionNames
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Arrays of an .npz drive file from ARKit's blendshapes [T] by their plain names, and the names that move nothing."""
    values = dict(values)
    eyelids = np.stack([values.pop(f"eyeblink{side}", np.zeros(frames)) for side in ("left", "right")], axis=1)
    eyes = _gaze(values, frames)
    expression, jaw, unmapped = np.zeros((frames, num_expressions)), np.zeros((frames, 3)), []
    for name, value in values.items():
        if _POSE.fullmatch(name):
            continue
        targets = names.targets(name)
        if not targets and name == "jawopen":
            targets = {"jaw_x": JAW_OPEN_RADIANS}
        for target, weight in targets.items():
            if isinstance(target, str):
                jaw[:, JAW_TARGETS.index(target)] += weight * value
            else:
                expression[:, target] += weight * value
        if not targets and not name.startswith("eyelook"):
            unmapped.append(name)
    return {"expression": expression, "jaw": jaw, "eyes": eyes, "eyelids": eyelids}, unmapped


def _gaze(values: Mapping[str, np.ndarray], frames: int) -> np.ndarray:
    """Rotation vectors [T, 6] from EyeLook{In, Out, Up, Down}; x turns the eye down, y to the subject's left."""

    def look(direction: str, side: str) -> np.ndarray:
        return values.get(f"eyelook{direction}{side}", np.zeros(frames))

    columns = []
    for side, outwards in (("left", 1.0), ("right", -1.0)):
        down = look("down", side) - look("up", side)
        to_left = outwards * (look("out", side) - look("in", side))
        columns += [GAZE_RADIANS * down, GAZE_RADIANS * to_left, np.zeros(frames)]
    return np.stack(columns, axis=1)


def _timecode_fps(timecodes: Sequence[str]) -> float:
    """Frames of a whole second, HH:MM:SS:FF; the first and the last second are not whole."""
    seconds = Counter(match.group(0).rpartition(":")[0] for code in timecodes if (match := _TIMECODE.match(code)))
    whole = list(seconds.values())[1:-1]
    return float(np.median(whole)) if whole else ARKIT_FPS


def _read_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    text = read_text(path, MAX_BYTES)
    try:
        lines = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), strict=True) if row]
    except csv.Error as error:
        raise UserError(f"{path} cannot be read as CSV ({error})") from None
    if len(lines) < 2:
        raise UserError(f"{path} needs a line of column names and at least one frame")
    header, rows = lines[0], lines[1:]
    if double := [name for name, count in Counter(map(plain, header)).items() if count > 1]:
        raise UserError(f"{path} has two columns of the name {double[0] or 'nothing'}")
    for number, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise UserError(f"{path}, line {number}: {len(row)} values for {len(header)} columns")
    return header, rows


def _column(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]], column: int) -> np.ndarray:
    values = np.empty(len(rows))
    for i, row in enumerate(rows):
        try:
            values[i] = float(row[column])
        except ValueError:
            values[i] = math.nan
        if not math.isfinite(values[i]):
            raise UserError(f"{path}, line {i + 2}: {header[column]} is {row[column][:40]!r}, not a finite number")
    return values


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
