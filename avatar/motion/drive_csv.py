"""Drive files as CSV: the program's own columns, or ARKit's blendshapes as phone apps record them (Live Link Face)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from avatar.errors import UserError
from avatar.files.read import read_bytes
from avatar.head.expression_names import JAW_TARGETS, NAMES_FILE, ExpressionNames
from avatar.motion.csv_table import Table, own_name, parse_table
from avatar.motion.drive_times import Rate, find_rate, is_time

EYE_COLUMNS = tuple(f"{side}_eye_{axis}" for side in ("left", "right") for axis in "xyz")
EYELID_COLUMNS = ("eyelid_left", "eyelid_right")
MAX_BYTES = 2**27  # 50 minutes of ARKit at 60 frames a second
DEFAULT_FPS = 25.0  # where nothing tells
ARKIT_FPS = 60.0  # of Live Link Face, likewise
LARGEST = 1e4  # of any coefficient or length: beyond it a file is damaged, and arithmetic would overflow
LARGEST_SHAPE = 10.0  # of ARKit's blendshapes, which are 1 where a face does all it can: percent are no such values
# Where the head model does not say otherwise: what ARKit's 1 stands for. Rough means of what people can do; ARKit
# gives no angles with these blendshapes.
JAW_OPEN_RADIANS, GAZE_RADIANS = 0.35, 0.6
_POSE = re.compile(r"(head|lefteye|righteye)(yaw|pitch|roll)")
_SHAPE = re.compile(r"(eye|jaw|mouth|brow|cheek|nose|tongue).+")  # every blendshape of ARKit's begins so
_NUMBERED = re.compile(r"expression_(\d{1,6})")
_COUNTERS = ("frame", "frames", "framenumber", "index", "blendshapecount")


def read_drive_csv(
    path: Path, num_expressions: int, names: ExpressionNames, say: Callable[[str], None]
) -> dict[str, np.ndarray]:
    """A CSV's columns as the arrays of an .npz drive file. Raises UserError with the file, the line and the column."""
    table = parse_table(path, read_bytes(path, MAX_BYTES))
    shapes = [own_name(name) for name in table.header]
    is_arkit = "jawopen" in shapes or (shapes[0] == "timecode" and not any(map(_NUMBERED.fullmatch, table.header)))
    read = _from_arkit if is_arkit else _from_columns
    arrays, unread = read(table, num_expressions, names, say)
    unread += ["a column without a name"] * min(table.unnamed, 1)
    if unread:
        say(f"Note: left unread in {path.name}: {_some(unread)}")
    rate = find_rate(table, say)
    if rate is None:
        rate = Rate(ARKIT_FPS if is_arkit else DEFAULT_FPS, "assumed; a column time_s, in seconds, says otherwise")
    say(f"{path.name}: {len(table)} frames, {rate.fps:g} a second ({rate.source})")
    return arrays | {"fps": np.array(rate.fps)}


def _from_columns(
    table: Table, num_expressions: int, names: ExpressionNames, say: Callable[[str], None]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The program's own columns, and the names of those that are none."""
    path, coefficients, unread = table.path, dict[int, str](), []
    special = {name for name in (*JAW_TARGETS, *EYE_COLUMNS, *EYELID_COLUMNS) if name in table.header}
    for name in table.header:
        if name in special or is_time(name):
            continue
        numbered = _NUMBERED.fullmatch(name)
        index = int(numbered[1]) if numbered else names.index(name)
        if index is None:
            unread.append(name)
        elif index >= num_expressions:
            raise UserError(f"{path}: the column {name} is beyond the head model's {num_expressions} coefficients")
        elif index in coefficients:
            raise UserError(f"{path}: the columns {coefficients[index]} and {name} are the same coefficient")
        else:
            coefficients[index] = name
    if not coefficients:
        raise UserError(
            f"{path} has no column expression_0, expression_1, ... nor one of the head model's names (its columns: "
            f"{_some(table.header)}); see docs/reenact.md"
        )
    expression = np.zeros((len(table), max(coefficients) + 1))
    for index, name in coefficients.items():
        expression[:, index] = table.column(name, LARGEST)
    arrays = {"expression": expression}
    for key, columns in (("jaw", JAW_TARGETS), ("eyes", EYE_COLUMNS), ("eyelids", EYELID_COLUMNS)):
        given = [name for name in columns if name in special]
        if given and len(given) < len(columns):
            raise UserError(f"{path} has {given[0]} but not all of {', '.join(columns)}")
        if given:
            arrays[key] = np.stack([table.column(name, LARGEST) for name in columns], axis=1)
    return arrays, unread


def _from_arkit(
    table: Table, num_expressions: int, names: ExpressionNames, say: Callable[[str], None]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """ARKit's blendshapes: blinks become eyelids, the eyes' directions gaze, the rest coefficients of their names."""
    path, own, unread = table.path, dict[str, str](), []
    for name in table.header:
        shape = own_name(name)
        if is_time(name) or shape in _COUNTERS:
            continue
        if not (_SHAPE.fullmatch(shape) or _POSE.fullmatch(shape) or names.targets(shape)):
            unread.append(name)
        elif shape in own:
            raise UserError(f"{path}: the columns {own[shape]} and {name} are the same blendshape")
        else:
            own[shape] = name
    if not own:
        raise UserError(
            f"{path} has no column of a blendshape (its columns: {_some(table.header)}); see docs/reenact.md"
        )
    values = {
        shape: table.column(name, LARGEST if _POSE.fullmatch(shape) else LARGEST_SHAPE) for shape, name in own.items()
    }
    return from_arkit(path, own, values, num_expressions, names, say), unread


def from_arkit(
    path: Path,
    own: Mapping[str, str],
    values: Mapping[str, np.ndarray],
    num_expressions: int,
    names: ExpressionNames,
    say: Callable[[str], None],
) -> dict[str, np.ndarray]:
    """Arrays of an .npz drive file from ARKit's blendshapes [T] by their plain names; `own` has the file's names for them.
    Says what moves nothing; raises UserError where the head model has no name for any that moves."""
    frames = len(next(iter(values.values())))
    arrays, unmapped = from_blendshapes(values, frames, num_expressions, names)
    lost = [shape for shape in unmapped if values[shape].any() and shape != "tongueout"]  # no head model has a tongue
    if lost and not any(names.targets(shape) for shape in values):
        known = (
            "no name of the head model's expressions is one of them" if names.names else "the head model has no names"
        )
        raise UserError(
            f"{path} holds ARKit's blendshapes, and {known}: put {NAMES_FILE} beside the model file, with the name of each "
            "coefficient or ARKit's weights (docs/reenact.md)"
        )
    if unmapped:
        shown = _some([own[shape] for shape in unmapped])
        say(f"Note: {len(unmapped)} of ARKit's blendshapes move nothing on this head model: {shown}")
    if any(shape.startswith("head") for shape in values if _POSE.fullmatch(shape)):
        say(f"Note: the head's turns in {path.name} are not used; the avatar's own camera is shown")
    return arrays


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


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
