"""Objects of JSON files against the annotations of a dataclass."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from avatar.data.json_values import parse_object


@dataclass(frozen=True)
class Part:
    text: str


@dataclass(frozen=True)
class Whole:
    count: int
    share: float
    is_on: bool
    place: Path | None
    pair: tuple[int, int]
    parts: tuple[Part, ...]
    words: Mapping[str, str]
    numbered: dict[int, str]
    anything: Any
    given: Part | None = None


RAW: dict[str, Any] = {
    "count": 3,
    "share": 1,
    "is_on": True,
    "place": "/a",
    "pair": [1, 2],
    "parts": [{"text": "x"}],
    "words": {"a": "b"},
    "numbered": {"7": "seven"},
    "anything": [None],
    "more": 1,
}


def test_an_object_is_parsed_by_its_annotations() -> None:
    found = parse_object(RAW, Whole, given=Part("y"))
    assert found == Whole(
        3, 1.0, True, Path("/a"), (1, 2), (Part("x"),), {"a": "b"}, {7: "seven"}, [None], given=Part("y")
    )
    assert isinstance(found.share, float) and parse_object({**RAW, "place": None, "given": None}, Whole).place is None


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"count": True}, "count is not a whole number"),
        ({"count": 1.0}, "count is not a whole number"),
        ({"share": float("nan")}, "share is not a finite number"),
        ({"is_on": 1}, "is_on is not true or false"),
        ({"place": 1}, "place is not text"),
        ({"pair": [1]}, "pair has 1 values, not 2"),
        ({"pair": "12"}, "pair is not a list"),
        ({"parts": [{"text": "x"}, {}]}, "parts[1].text is missing"),
        ({"parts": ["x"]}, "parts[0] is not an object"),
        ({"words": {"a": None}}, "words.a is not text"),
        ({"words": []}, "words is not an object"),
        ({"numbered": {"-1": "x"}}, "numbered has the key '-1', not a number"),
    ],
)
def test_what_is_no_such_object_is_named(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        parse_object({**RAW, **change}, Whole, given=None)
