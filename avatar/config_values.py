"""Values of configuration keys: read from what was typed, and checked, with plain words about what is wrong."""

from __future__ import annotations

import re
import types
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from avatar.data.colours import COLOUR_WORDS, Colour, parse_colour
from avatar.errors import UserError

DEVICE = re.compile(r"auto|cpu|cuda(:[0-9]{1,3})?")
_NULLS, _TRUTHS = ("null", "~"), {"true": True, "false": False}
_KINDS: dict[type, str] = {int: "a whole number", float: "a number", str: "a word", bool: "true or false"}


class Range(NamedTuple):
    """The values that a key may have, both ends included."""

    low: float
    high: float


def config_dir() -> Path:
    """The folder of YAML files: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "configs", package.parent / "configs"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise UserError(f"the configuration files are missing from the installation ({package / 'configs'})")


def typed_value(text: str, declared: Any) -> int | float | bool | str | None:
    """What was typed after `key=`: a number, null, true, false, or else the text itself, without quotes around it.

    A key that is `declared` to take a name takes the text as it is written: camera 01 is not camera 1.
    """
    word = text.strip()
    if len(word) >= 2 and word[0] == word[-1] and word[0] in "'\"":
        word = word[1:-1]
    if word.lower() in _NULLS:
        return None
    if _wanted(get_args(declared)[0]) is str:
        return word
    if word.lower() in _TRUTHS:
        return _TRUTHS[word.lower()]
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return word


def checked_value(key: str, value: Any, declared: Any) -> Any:
    """`value` as the annotation of a field of the configuration declares it: its type, its range or its choices.

    A number without a fraction counts as whole however it is written (1e3). Raises UserError with what is expected.
    """
    kind, *others = get_args(declared) if get_origin(declared) is Annotated else (declared,)
    checked = _of_type(key, value, kind)
    for limits in (other for other in others if isinstance(other, Range)):
        _check_range(key, checked, limits)
    return checked


def meaning_of(declared: Any) -> str:
    """The sentence of a field's annotation."""
    return next((other for other in get_args(declared) if isinstance(other, str)), "")


def _of_type(key: str, value: Any, kind: Any) -> Any:
    options, wanted = _options(kind), _wanted(kind)
    if value is None and types.NoneType in options:
        return None
    if get_origin(wanted) is tuple:
        return checked_colour(key, value)
    choices: tuple[Any, ...] = get_args(wanted) if get_origin(wanted) is Literal else ()
    wanted = type(choices[0]) if choices else wanted
    if isinstance(value, wanted) and isinstance(value, bool) == (wanted is bool):
        if choices and value not in choices:
            raise UserError(f"{key}={shown(value)} is not one of {', '.join(map(str, choices))}")
        return value
    if wanted is str and not choices and isinstance(value, int) and not isinstance(value, bool):
        return str(value)  # a name that is a number
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        return float(max(min(value, 10**300), -(10**300)))  # beyond that there is no float; every range refuses it
    if wanted is int and isinstance(value, float) and value.is_integer():
        return int(value)
    or_null = ", or null" if types.NoneType in options else ""
    raise UserError(f"{key}={shown(value)} is not valid: it must be {_KINDS[wanted]}{or_null}")


def _options(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)


def _wanted(kind: Any) -> Any:
    """What a key's values are of where they are not null."""
    return next(option for option in _options(kind) if option is not types.NoneType)


def checked_colour(key: str, value: Any) -> Colour:
    try:
        return parse_colour(value)
    except (ValueError, OverflowError):
        raise UserError(f"{key}={shown(value)} is not valid: it must be {COLOUR_WORDS}") from None


def _check_range(key: str, value: float | None, limits: Range) -> None:
    """Raise UserError where `value` is out of range; NaN always is."""
    if value is not None and not limits.low <= value <= limits.high:
        ends = f"from {shown(limits.low)} to {shown(limits.high)}"
        raise UserError(f"{key}={shown(value)} is out of range: it must be {ends}")


def check_device(name: str) -> None:
    if not DEVICE.fullmatch(name):
        raise UserError(f"device={shown(name)} is not one of auto, cpu, cuda, cuda:N (such as cuda:0)")


def shown(value: Any, most: int = 60) -> str:
    """A value as it is typed, cut to `most` letters: short enough for a message."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        value = int(value)
    text = "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def cause(error: Exception) -> str:
    """The first line of the innermost message: Hydra wraps the cause in several others."""
    while error.__cause__ is not None and isinstance(error.__cause__, Exception):
        error = error.__cause__
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
