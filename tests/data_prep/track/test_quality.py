"""Grades of a tracking, and what is said beside them."""

from __future__ import annotations

import math

import pytest

from data_prep.track.quality import Figure, Quality


@pytest.mark.parametrize(
    ("value", "more", "grade"),
    [
        (1.0, False, "good"), (1.01, False, "fair"), (2.0, False, "fair"), (2.01, False, "poor"),
        (99.0, True, "good"), (98.9, True, "fair"), (90.0, True, "fair"), (89.9, True, "poor"),
        (math.nan, False, "poor"), (math.nan, True, "poor"), (math.inf, False, "poor"),
    ],
)  # fmt: skip
def test_grades(value: float, more: bool, grade: str) -> None:
    bounds = (99.0, 90.0) if more else (1.0, 2.0)
    figure = Figure("error", value, "px", *bounds, "track again", more)
    assert figure.grade == grade
    assert ("-> track again" in figure.line()) == (grade != "good") and grade in figure.line()
    assert figure.to_json()["grade"] == grade


def test_figures_without_bounds_are_told_only() -> None:
    figure = Figure("texture", 31.5, "dB")
    assert figure.grade is None and figure.to_json() == {"name": "texture", "value": 31.5, "unit": "dB"}
    assert figure.line().split() == ["texture", "31.500", "dB"]


def test_the_terminals_lines() -> None:
    quality = Quality((Figure("error", 1.5, "px", 1.0, 2.0, "track again"),), (3, 17), "given with --focal")
    assert quality.lines()[0] == "quality of the tracking"
    assert quality.lines()[-1] == "  frames that fit worst: 00003, 00017"
    assert quality.to_json()["focal"] == "given with --focal"
