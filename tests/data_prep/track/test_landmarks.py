from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar.errors import UserError
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks, load_landmarks, save_landmarks


def some_landmarks(frames: int = 4) -> Landmarks:
    rng = np.random.default_rng(0)
    return Landmarks(
        points=rng.uniform(0, 640, (frames, NUM_POINTS, 3)).astype(np.float32),
        scores=rng.uniform(0, 1, (frames, len(BLENDSHAPES))).astype(np.float32),
        detected=np.arange(frames) != 1,
        size=(640, 480),
        fps=29.97,
    )


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    written = some_landmarks()
    save_landmarks(tmp_path / "landmarks.npz", written)
    read = load_landmarks(tmp_path / "landmarks.npz")
    for name in ("points", "scores", "detected"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
        assert getattr(read, name).dtype == getattr(written, name).dtype
    assert (read.size, read.fps, len(read)) == ((640, 480), 29.97, 4)
    np.testing.assert_array_equal(read.score("jawOpen"), written.scores[:, 25])


def test_there_are_52_different_blendshapes() -> None:
    assert len(BLENDSHAPES) == len(set(BLENDSHAPES)) == 52


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((4, 468, 3), np.float32)}, "points is float32 .4, 468, 3., expected .4, 478, 3."),
        ({"scores": np.zeros((3, 52), np.float32)}, "scores is float32 .3, 52."),
        ({"points": np.full((4, 478, 3), np.nan, np.float32)}, "points holds values that are not finite"),
        ({"size": (0, 5)}, "frames of 0x5 pixels"),
        ({"fps": -1.0}, "at -1 per second"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path: Path, change: dict, message: str) -> None:
    path = tmp_path / "landmarks.npz"
    save_landmarks(path, replace(some_landmarks(), **change))
    with pytest.raises(UserError, match=message):
        load_landmarks(path)


def test_another_archive_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", detected=np.zeros((2, 2)))
    with pytest.raises(UserError, match="size is missing"):
        load_landmarks(tmp_path / "other.npz")


def test_a_coordinate_too_large_for_float32_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.npz"
    points = np.zeros((1, NUM_POINTS, 3))
    points[0, 5, 1] = 1e300
    scores = np.zeros((1, len(BLENDSHAPES)), np.float32)
    np.savez(path, points=points, scores=scores, detected=np.ones(1, bool), size=np.array([8, 8]), fps=np.float64(25))
    with pytest.raises(UserError, match="points holds values that are not finite"):
        load_landmarks(path)
