"""What is taken of a video: which shot, which part of the picture, which lens."""

from __future__ import annotations

import math

import numpy as np
import pytest

from avatar.errors import UserError
from data_prep.track.crop import choose_view, head_square, parse_crop
from data_prep.track.faces.landmarks import Landmarks
from data_prep.track.fit.focal import choose_focal
from data_prep.track.footage.cuts import CutFinder
from data_prep.track.footage.source import Box, Span, check_span, stride, whole
from data_prep.track.frames import in_view


def textured(seed: int, size: int = 96) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 256, (6, 6, 3)), np.ones((size // 6, size // 6, 1))).astype(np.uint8)


def shots(pictures: list[np.ndarray]) -> list[tuple[int, int]]:
    cuts = CutFinder()
    for picture in pictures:
        cuts.add(picture)
    return [tuple(shot) for shot in cuts.shots()]


def test_cuts_are_found_and_motion_is_none() -> None:
    moving = [np.roll(textured(1), 2 * n, axis=1) for n in range(20)]
    other = [np.roll(textured(2), -2 * n, axis=0) for n in range(12)]
    assert shots(moving) == [(0, 20)]
    assert shots([*moving, *other]) == [(0, 20), (20, 32)]
    assert shots([*moving, *other, *moving[:5]]) == [(0, 20), (20, 32), (32, 37)]


def test_pictures_that_never_resemble_each_other_are_one_shot() -> None:
    assert shots([textured(n) for n in range(20)]) == [(0, 20)]  # one picture a second, say


def face(x: float, y: float, height: float, frames: int = 40) -> np.ndarray:
    """Landmarks [T, 478, 3] of a face of that height around a point; irises 0.3 heights apart."""
    rng = np.random.default_rng(0)
    points = np.zeros((frames, 478, 3))
    angles = rng.uniform(0, 2 * np.pi, 478)
    points[:, :, 0], points[:, :, 1] = x + 0.4 * height * np.cos(angles), y + 0.5 * height * np.sin(angles)
    points[:, 0, :2], points[:, 1, :2] = (x, y - height / 2), (x, y + height / 2)
    points[:, 468, :2], points[:, 473, :2] = (x - 0.15 * height, y), (x + 0.15 * height, y)
    return points


def test_the_square_around_the_head() -> None:
    box = head_square(1920, 1080, face(1000, 400, 300))
    assert box.width == box.height and box.x % 2 == box.y % 2 == 0
    assert box.y < 400 - 150 - 100 and box.y + box.height > 400 + 150 + 150  # hair and neck
    assert box.x + box.width / 2 == pytest.approx(1000, abs=2)
    assert (box.y, box.y + box.height) == pytest.approx((250 - 0.55 * 300, 550 + 0.75 * 300), abs=3)
    moved = np.concatenate((face(900, 400, 300), face(1100, 400, 300)))
    assert head_square(1920, 1080, moved).width > box.width


def test_the_square_stays_in_the_picture() -> None:
    assert head_square(1920, 1080, face(100, 100, 300)) == Box(
        0, 0, *(head_square(1920, 1080, face(960, 540, 300))[2:])
    )
    for width, height in ((512, 512), (720, 1280), (511, 333)):
        box = head_square(width, height, face(width / 2, height / 2, 0.7 * min(width, height)))
        assert box.width == min(width, height) and box.x + box.width <= width and box.y + box.height <= height


def test_views() -> None:
    points = face(1000, 400, 300)
    auto = choose_view("auto", None, 1920, 1080, points)
    assert (auto.width, auto.height) == (512, 512) and auto.box.width > 512
    assert choose_view("auto", 256, 1920, 1080, points).width == 256
    none = choose_view("none", None, 1921, 1081, points)
    assert (none.box, none.width, none.height) == (Box(0, 0, 1921, 1081), 1921, 1081)
    assert choose_view("none", 960, 1920, 1080, points).height == 540
    given = choose_view(Box(11, 7, 301, 200), None, 1920, 1080, points)
    assert (given.width, given.height) == (301, 200)
    small = choose_view("auto", 4096, 200, 200, face(100, 100, 100))
    assert small.width == small.box.width  # nothing is enlarged
    x, y = auto.to_view(auto.box.x + auto.box.width / 2, auto.box.y)
    assert (x, y) == (256, 0)


def test_landmarks_in_a_view() -> None:
    """Where `to_view` has their places; those of pictures without a face are nowhere."""
    points = face(1000, 400, 300, frames=3).astype(np.float32)
    seen = Landmarks(points, np.zeros((3, 52), np.float32), np.array([True, False, True]), (1920, 1080), 25.0)
    view = choose_view(Box(700, 100, 600, 400), 300, 1920, 1080, points)
    found = in_view(seen, view)
    assert found.size == (view.width, view.height) == (300, 200)
    assert found.points[2, 7, :2] == pytest.approx(view.to_view(*points[2, 7, :2].tolist()), abs=1e-3)
    assert not found.points[1].any() and (points[1] != 0).any()


@pytest.mark.parametrize(
    ("crop", "size", "sentence"),
    [
        (
            Box(1900, 0, 100, 100),
            None,
            "--crop 1900,0,100,100 must lie in the video's 1920x1080 pixels and have 64 a side",
        ),
        (Box(0, 0, 100, 30), None, "must lie in the video's 1920x1080 pixels"),
        ("auto", 10, "--size must be from 64 to 4096 pixels, not 10"),
    ],
)
def test_views_that_cannot_be(crop: Box, size: int | None, sentence: str) -> None:
    with pytest.raises(UserError) as caught:
        choose_view(crop, size, 1920, 1080, face(1000, 400, 300))
    assert sentence in str(caught.value)


def test_the_crop_as_it_is_typed() -> None:
    assert parse_crop("auto") == "auto" and parse_crop("none") == "none"
    assert parse_crop("1, 2,300,400") == Box(1, 2, 300, 400)
    for text in ("", "1,2,3", "1,2,3,4,5", "-1,2,300,300", "a,b,c,d", "1.5,2,3,4", "1e9,2,3,4"):
        with pytest.raises(UserError, match="--crop must be auto, none or X,Y,W,H"):
            parse_crop(text)


def test_the_lens() -> None:
    far, near = face(960, 540, 100), face(960, 540, 900)
    assert choose_focal(1920, 1080, far, given=1500.0) == (1500.0, "given with --focal", False)
    angle = choose_focal(1920, 1080, far, field_of_view=60.0)
    assert angle.pixels == pytest.approx(960 / math.tan(math.radians(30))) and not angle.is_assumed
    known = choose_focal(1920, 1080, far, equivalent=26.0)
    assert known.pixels == pytest.approx(26 / math.hypot(36, 24) * math.hypot(1920, 1080)) and not known.is_assumed
    assumed = choose_focal(1920, 1080, far)
    assert assumed.pixels == pytest.approx(28 / math.hypot(36, 24) * math.hypot(1920, 1080)) and assumed.is_assumed
    # Eyes 270 pixels apart seem nearer than an arm is long: the video was cut out of a larger one, of a usual distance.
    cropped = choose_focal(1920, 1080, near)
    assert cropped.pixels == pytest.approx(0.9 * 270 / 0.063) and "the face is 0.9 m away" in cropped.source
    eyes = assumed.pixels * 0.063 / 0.6  # apart, of a face at an arm's length of the assumed lens
    at_arms_length = [choose_focal(1920, 1080, face(960, 540, width * eyes / 0.3)).pixels for width in (0.99, 1.01)]
    assert at_arms_length == pytest.approx([assumed.pixels, 0.9 * 1.01 * eyes / 0.063])
    assert choose_focal(1920, 1080, near, given=1500.0, equivalent=26.0).pixels == 1500.0


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"given": 3.0}, "--focal must be in pixels of the video (1920x1080), not 3"),
        ({"given": math.nan}, "--focal must be in pixels"),
        ({"field_of_view": 180.0}, "--fov must be from 1 to 150 degrees across the width of the video, not 180"),
    ],
)
def test_lenses_that_cannot_be(options: dict[str, float], sentence: str) -> None:
    with pytest.raises(UserError) as caught:
        choose_focal(1920, 1080, face(960, 540, 100), **options)
    assert sentence in str(caught.value)


def test_parts_of_the_video() -> None:
    check_span(Span(1.0, 2.0), 5.0)
    for span, sentence in (
        (Span(-1.0), "--start must be a time"),
        (Span(math.nan), "--start must be a time"),
        (Span(2.0, 1.0), "--end must be a time in seconds after --start"),
        (Span(9.0), "--start 9 is behind the end of the video, which is 5.00 s long"),
    ):
        with pytest.raises(UserError) as caught:
            check_span(span, 5.0)
        assert sentence in str(caught.value)


def test_rates_that_are_thinned() -> None:
    assert [stride(rate) for rate in (None, 1.0, 25.0, 30.0, 31.9, 50.0, 60.0, 120.0, 240.0)] == [
        1,
        1,
        1,
        1,
        1,
        2,
        2,
        4,
        8,
    ]
    view = whole(4000, 3000, 1920)
    assert (view.width, view.height) == (1920, 1440) and whole(640, 480, 1920).width == 640
