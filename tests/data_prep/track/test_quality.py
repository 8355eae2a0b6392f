"""Grades of a tracking, and what is said beside them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from heads import grid_head
from some_tracks import track

from data_prep.track import quality
from data_prep.track.faces.embedding import LandmarkEmbedding
from data_prep.track.faces.landmark_groups import LEFT_IRIS, LIPS, NOSE
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks
from data_prep.track.fit.focal import Focal
from data_prep.track.fit.result import Fit
from data_prep.track.quality import Figure, Quality, grade_tracking, landmark_figures


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


def test_times_without_a_picture_are_no_frames_without_a_face() -> None:
    T, detected = 20, np.arange(20) % 4 != 0
    points, scores = np.zeros((T, NUM_POINTS, 3), np.float32), np.zeros((T, len(BLENDSHAPES)), np.float32)
    seen = Landmarks(points, scores, detected, (64, 64), 25.0)
    figures = {"errors": {"all": 1.0}, "inside": 1.0, "constant": 0.0, "irises": None, "jitter": 1.0, "identity": 0.0}
    fit = Fit({n: track() for n in np.flatnonzero(detected).tolist()}, figures | {"worst_frames": []})
    for pictures, share, grade in ((15, 100.0, "good"), (20, 75.0, "poor")):
        first = grade_tracking(seen, pictures, fit, [1.0], None, Focal(1.0, "given", False)).figures[0]
        assert (first.value, first.grade) == (share, grade)


def test_errors_are_what_changes_from_frame_to_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """In per cent of the irises' distance; where a landmark lies on this face in all frames is subtracted."""
    T, own = 40, (*NOSE, *LIPS)
    rng = np.random.default_rng(0)
    points = np.zeros((T, NUM_POINTS, 3), np.float32)
    points[:, own, :2] = 30.0 * rng.random((len(own), 2)) + 0.2 * rng.standard_normal((T, len(own), 2))
    points[:, LEFT_IRIS, 0] = 50.0
    seen = Landmarks(points, np.zeros((T, len(BLENDSHAPES)), np.float32), np.ones(T, bool), (64, 64), 25.0)
    still = points[:, own, :2].mean(0) + np.array([3.0, 4.0])  # 5 pixels away from where they are, in every frame
    placed = np.repeat(still[None], T, axis=0)
    placed[7, :, 0] += 2.5  # and 5 % of the irises' distance in this one
    monkeypatch.setattr(quality, "_placed", lambda *_: placed)
    tracks = {n: track() for n in range(T)}
    embedding = LandmarkEmbedding(np.array(own), np.zeros((len(own), 3), int), np.zeros((len(own), 3)))
    found = landmark_figures(grid_head(), Fit(tracks, {}), seen, embedding)
    assert found["constant"] == pytest.approx(10.0, abs=0.5) and found["errors"]["all"] < 1.0
    assert 7 in found["worst_frames"] and len(found["worst_frames"]) == 5
    monkeypatch.setattr(quality, "_placed", lambda *_: points[:, own, :2])
    assert landmark_figures(grid_head(), Fit(tracks, {}), seen, embedding)["jitter"] == pytest.approx(1.0)
    monkeypatch.setattr(quality, "_placed", lambda *_: np.repeat(still[None], T, axis=0))
    assert landmark_figures(grid_head(), Fit(tracks, {}), seen, embedding)["jitter"] == 0.0


def test_the_share_of_the_face_inside_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.zeros((4, NUM_POINTS, 3), np.float32)
    points[:, LEFT_IRIS, 0] = 50.0
    seen = Landmarks(points, np.zeros((4, len(BLENDSHAPES)), np.float32), np.ones(4, bool), (64, 48), 25.0)
    placed = np.zeros((4, len(NOSE), 2))
    placed[0, 0], placed[1, 0], placed[2, 0] = (64.0, 0.0), (0.0, 48.0), (-0.1, 3.0)  # beyond three of the edges
    placed[3, 0] = 63.9, 47.9
    monkeypatch.setattr(quality, "_placed", lambda *_: placed)
    embedding = LandmarkEmbedding(np.array(NOSE), np.zeros((len(NOSE), 3), int), np.zeros((len(NOSE), 3)))
    found = landmark_figures(grid_head(), Fit({n: track() for n in range(4)}, {}), seen, embedding)
    assert found["inside"] == pytest.approx(1 - 3 / (4 * len(NOSE)))


def test_where_a_face_comes_back_is_no_jitter(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit that trembles twice as much as the landmarks does so whether the face was away or not."""
    T, rng = 40, np.random.default_rng(0)
    tremble = 0.2 * rng.standard_normal((T, len(NOSE), 2))
    away = np.where(np.arange(T) < 20, 0.0, 300.0)[:, None, None]  # pixels
    points = np.zeros((T + 5, NUM_POINTS, 3), np.float32)
    numbers = [*range(20), *range(25, 45)]
    rows = np.zeros((T, NUM_POINTS, 3), np.float32)
    rows[:, NOSE, :2] = tremble + away
    rows[:, LEFT_IRIS, 0] = 50.0
    points[numbers] = rows
    detected = np.isin(np.arange(T + 5), numbers)
    seen = Landmarks(points, np.zeros((T + 5, len(BLENDSHAPES)), np.float32), detected, (640, 640), 25.0)
    monkeypatch.setattr(quality, "_placed", lambda *_: 2 * tremble + away)
    embedding = LandmarkEmbedding(np.array(NOSE), np.zeros((len(NOSE), 3), int), np.zeros((len(NOSE), 3)))
    found = landmark_figures(grid_head(), Fit({n: track() for n in numbers}, {}), seen, embedding)
    assert found["jitter"] == pytest.approx(2.0, abs=0.01)


def test_the_terminals_lines() -> None:
    told = Quality((Figure("error", 1.5, "px", 1.0, 2.0, "track again"),), (3, 17), "given with --focal")
    assert told.lines()[0] == "quality of the tracking"
    assert told.lines()[-1] == "  frames that fit worst: 00003, 00017"
    assert told.to_json()["focal"] == "given with --focal"
