"""Instructions while a person is filmed, by drawn faces whose state is known."""

from __future__ import annotations

import numpy as np
import pytest
from posing import picture, posed

from data_prep.live.recording_guidance import ENDS, PATIENCE, PROMPTS, RecordingAdvice, Seen, measures, reaches
from data_prep.track.faces.detect import Face

PICTURE = picture()


@pytest.mark.parametrize(
    ("image", "face", "advice"),
    [
        (PICTURE, posed(), ""),
        (picture(light=0.7), posed(), ""),
        (PICTURE, None, "no face: look into the camera"),
        (PICTURE, posed(height=190), "come closer"),
        (PICTURE, posed(height=400), "go back a little"),
        (PICTURE, posed(x=110), "move to the middle"),
        (PICTURE, posed(x=540), "move to the middle"),
        (PICTURE, posed(y=180), "move to the middle"),
        (PICTURE, posed(y=345), "move to the middle"),
        (picture(light=0.4), posed(), "more light on the face"),
        (picture(light=2.0), posed(), "less light on the face"),
        (picture(blur=8.0), posed(), "hold still"),
    ],
)
def test_what_is_wrong_is_said(image: np.ndarray, face: Face | None, advice: str) -> None:
    adviser = RecordingAdvice()
    for _ in range(20):
        assert adviser.problem(PICTURE, posed()) == ""
    assert adviser.problem(image, face) == advice


def test_a_camera_out_of_focus_is_told_from_a_movement() -> None:
    adviser = RecordingAdvice()
    assert {adviser.problem(picture(blur=8.0), posed()) for _ in range(5)} == {"focus the camera, or wipe its lens"}


def test_advice_waits_for_half_a_second_and_ends_at_once() -> None:
    adviser, small = RecordingAdvice(), posed(height=150)
    said = [adviser.advise(PICTURE, small if 10 <= n < 30 else posed(), n / 20) for n in range(40)]
    wait = round(20 * PATIENCE)
    assert said == [""] * (10 + wait) + ["come closer"] * (20 - wait) + [""] * 10
    flicker = [adviser.advise(PICTURE, small if n % 2 else None, 2 + n / 20) for n in range(40)]
    assert set(flicker) == {""}, "each of them is there for one picture"


@pytest.mark.parametrize(("yaw", "pitch"), [(30, 0), (-30, 0), (0, 15), (0, -15)])
def test_turns_are_measured_in_degrees(yaw: float, pitch: float) -> None:
    values = measures(posed(yaw=yaw, pitch=pitch))
    assert values["degrees left"] == pytest.approx(yaw, abs=0.1) and values["degrees right"] == -values["degrees left"]
    assert values["degrees up"] == pytest.approx(pitch, abs=0.1) and values["degrees down"] == -values["degrees up"]


def test_scores_are_of_both_sides() -> None:
    values = measures(posed(jawOpen=0.4, mouthSmileLeft=0.6, eyeBlinkLeft=0.8, eyeBlinkRight=0.6, eyeLookOutLeft=0.5))
    expected = {"mouth open": 0.4, "smile": 0.3, "lids closed": 0.7, "eyes left": 0.25, "eyes right": 0.0}
    assert {name: values[name] for name in expected} == pytest.approx(expected)


def test_prompts_take_a_minute_and_ask_for_all_that_is_measured() -> None:
    assert len(ENDS) == len(PROMPTS) and ENDS[-1] == 60
    assert {name for prompt in PROMPTS for name in prompt.least} == {*measures(posed())}


SMILE = next(n for n, prompt in enumerate(PROMPTS) if "smile" in prompt.least)
BEGIN = sum(prompt.seconds for prompt in PROMPTS[:SMILE])


def smiled(begin: float, seconds: float, rest: float = 0.0) -> float:
    """What the smile's prompt reaches where the person smiled then."""
    times = np.arange(0, BEGIN + 8, 0.05)
    scores = [0.8 if begin <= time < begin + seconds else rest for time in times]
    seen = [
        Seen(time, measures(posed(mouthSmileLeft=s, mouthSmileRight=s))) for time, s in zip(times, scores, strict=True)
    ]
    reached = reaches(seen)
    assert reached[0] == {} and reached[-1] is None
    found = reached[SMILE]
    assert found is not None
    return found["smile"]


def test_a_range_is_what_was_held_in_its_time() -> None:
    assert smiled(BEGIN + 1, 2.0) == pytest.approx(0.8)
    assert smiled(BEGIN + 1, 2.0, rest=0.3) == pytest.approx(0.5), "beyond the calm face"
    assert smiled(BEGIN + 1, 0.2) == 0, "too short"
    assert smiled(BEGIN + PROMPTS[SMILE].seconds - 0.1, 1.0) == pytest.approx(0.8), "late"
    assert smiled(BEGIN - 3, 2.0) == 0, "before it was asked"
