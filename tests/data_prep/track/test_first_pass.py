"""What is looked at first: which part of it, how much of it there may be, and what the libraries print meanwhile."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from marked_face import HEIGHT, WIDTH, MarkDetector, picture

from avatar.errors import UserError
from data_prep.progress import silent
from data_prep.track.faces.detect import Face, FaceDetector, quiet
from data_prep.track.first_pass import look_at
from data_prep.track.footage.source import Span, TimedPicture


def filmed(pictures: list[np.ndarray], begins: float = 0.0) -> Any:
    """Pictures that begin so many seconds into a video of ten minutes, 25 a second."""

    def read(*_: object) -> Iterator[TimedPicture]:
        return (TimedPicture(begins + n / 25, image) for n, image in enumerate(pictures))

    height, width = pictures[0].shape[:2]
    return SimpleNamespace(
        is_joined=False, width=width, height=height, duration=600.0, rate=25.0, path=Path("v.mp4"), read=read
    )


def test_the_shot_with_the_most_faces_is_taken_and_not_called_the_longest(with_marks: None) -> None:
    empty = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    bright = np.maximum(picture(), np.where(picture() == 90, 200, 0)).astype(np.uint8)
    look = look_at(filmed([empty] * 30 + [bright] * 5 + [picture()] * 20), Span(), silent)
    assert look.pictures.tolist() == list(range(35, 55)) and look.landmarks.detected.all()
    (note,) = look.notes
    assert "2 shots" in note and "most pictures of a face" in note and "20 of 55 pictures" in note


class Overlooking(FaceDetector):
    """Overlooks faces that are small in what it looks at, as MediaPipe's landmarker does."""

    def __init__(self) -> None:
        self._last = None

    def close(self) -> None:
        pass

    def _in_window(self, image: np.ndarray, window: tuple[int, int, int, int]) -> list[Face]:
        left, top, right, bottom = window
        face = MarkDetector().anywhere(image[top:bottom, left:right])
        if face is None or face.height < 0.13 * max(right - left, bottom - top):
            return []
        return [Face(face.points + np.array([left, top, 0], np.float32), face.scores)]


def test_a_small_face_is_found_behind_a_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("data_prep.track.first_pass.FaceDetector", Overlooking)

    def shot(grey: int, x: int, y: int, height: int) -> np.ndarray:
        image = np.tile(np.linspace(grey, grey + 40, 640).astype(np.uint8)[:, None], (360, 1, 3))
        for down, colour in ((0, (255, 0, 0)), (height, (0, 0, 255))):
            cv2.circle(image, (x, y + down), 4, colour, -1)
        return image

    near, far = shot(90, 200, 60, 200), shot(140, 500, 180, 40)
    look = look_at(filmed([near] * 12 + [far] * 20), Span(), silent)
    assert look.pictures.tolist() == list(range(12, 32)) and look.landmarks.detected.all()
    assert np.abs(look.landmarks.points[0, 10, :2] - (500.5, 180.5)).max() < 1


def test_the_part_of_a_long_video_that_is_used_is_named_where_it_lies(
    with_marks: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("data_prep.track.first_pass.MAX_PICTURES", 25)
    look = look_at(filmed([picture()] * 30, begins=300.0), Span(300.0), silent)
    (note,) = look.notes
    assert not look.is_whole and "longer than 25 pictures" in note and "from 300.0 to 301.0 s" in note


def test_recordings_that_are_too_long_together_are_refused_before_any_is_looked_at() -> None:
    joined: Any = SimpleNamespace(is_joined=True, width=64, height=64, duration=200.0, rate=25.0)
    with pytest.raises(UserError, match="the recordings have 5000 times together; give at most 3600"):
        look_at(joined, Span(), silent)


def test_two_threads_that_are_quiet_leave_the_standard_error_where_it_was() -> None:
    before, first_in, second_in, first_out = os.fstat(2), *(threading.Event() for _ in range(3))

    def first() -> None:
        with quiet():
            first_in.set()
            second_in.wait(0.3)  # which it cannot be
        first_out.set()

    def second() -> None:
        first_in.wait()
        with quiet():
            second_in.set()
            first_out.wait()

    threads = [threading.Thread(target=act) for act in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert os.path.samestat(os.fstat(2), before)
