"""Values of JSON files, which may be anything."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

T = TypeVar("T")
_KINDS = {int: "a whole number", str: "text", bool: "true or false", tuple: "a list", dict: "an object"}
_fields = cache(get_type_hints)


def parse_object(raw: Any, kind: type[T], name: str = "", /, **known: Any) -> T:
    """The dataclass `kind` of an object, which has a key for each of its fields but the `known` ones; other keys are left
    unread. Raises ValueError naming the key."""
    parse_value(raw, dict, name or "it")
    kinds = {key: one for key, one in _fields(kind).items() if key not in known}
    below = f"{name}." if name else ""
    if missing := [key for key in kinds if key not in raw]:
        raise ValueError(f"{below}{missing[0]} is missing")
    return kind(**known, **{key: parse_value(raw[key], one, f"{below}{key}") for key, one in kinds.items()})


def parse_value(value: Any, kind: Any, name: str) -> Any:
    """A value as the annotation of a field declares it. Raises ValueError naming it."""
    plain, inner = get_origin(kind) or kind, get_args(kind)
    if plain is Any:
        return value
    if plain is UnionType:  # X | None
        return None if value is None else parse_value(value, inner[0], name)
    if is_dataclass(plain):
        return parse_object(value, kind, name)
    if plain is float:
        return parse_number(value, name)
    if plain is Path:
        return Path(parse_value(value, str, name))
    plain = dict if plain is Mapping else plain
    if not isinstance(value, (list, tuple) if plain is tuple else plain) or isinstance(value, bool) != (plain is bool):
        raise ValueError(f"{name} is not {_KINDS[plain]}")
    if plain is tuple:
        kinds = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
        if len(kinds) != len(value):
            raise ValueError(f"{name} has {len(value)} values, not {len(kinds)}")
        return tuple(parse_value(one, of, f"{name}[{n}]") for n, (one, of) in enumerate(zip(value, kinds, strict=True)))
    if plain is dict and inner:
        if wrong := [key for key in value if inner[0] is int and not key.isdecimal()]:
            raise ValueError(f"{name} has the key {wrong[0]!r}, not a number")
        return {inner[0](key): parse_value(one, inner[1], f"{name}.{key}") for key, one in value.items()}
    return value


def parse_number(value: Any, name: str) -> float:
    """A finite number. Raises ValueError naming it."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{name} is not a finite number")
    return float(value)


def parse_intrinsics(values: Any) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy. Raises TypeError or ValueError."""
    if not isinstance(values, list):
        raise TypeError(f"intrinsics is a {type(values).__name__}, not a list")
    if len(values) != 4:
        raise ValueError(f"intrinsics has {len(values)} values, not 4")
    fx, fy, cx, cy = (parse_number(v, "intrinsics") for v in values)
    return fx, fy, cx, cy


def parse_positions(values: Any, key: str, count: int) -> tuple[int, ...]:
    """A list of positions among `count` frames, not empty. Raises TypeError or ValueError naming `key`."""
    if not isinstance(values, list):
        raise TypeError(f"{key} is a {type(values).__name__}, not a list")
    if not values or not all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v < count for v in values):
        raise ValueError(f"{key} is empty or names frames outside the {count} of the subject")
    return tuple(values)
