"""The background of a camera that stands still, and the gaps that it shows in a person's outline."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from avatar.demo.identity import sample_identity
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.raw_video import expose, make_room
from avatar.demo.render import Renderer
from data_prep.track.mattes import closed_form_matting
from data_prep.track.mattes.background_plate import learn_plate, shown
from data_prep.track.mattes.refine_segmentation import sharpened

SIZE, NOISE = 160, 1.5
HAIR = (40, 30, 25)


def wall(size: int = SIZE) -> np.ndarray:
    """A smooth wall with a dark shelf on the left."""
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    colours = np.stack([150 + 40 * x / size, 140 + 30 * y / size, 130 + 0.0 * x], axis=2)
    colours[size // 3 : size // 2, : size // 3] = (70, 40, 90)
    return colours


def head(at: int, gap: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """A head's true mask, with a notch at its top, and a network's matte, without it."""
    filled, true = np.zeros((SIZE, SIZE), np.uint8), np.zeros((SIZE, SIZE), np.uint8)
    cv2.circle(filled, (at, 95), 45, 255, -1)
    true[:] = filled
    if gap:
        cv2.circle(true, (at + 6, 51), 3, 0, -1)
    return true > 0, filled


def clip(
    colour: tuple[int, int, int] | None = HAIR, moves: int = 0
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Pictures, networks' mattes and true masks of a head that goes to and fro; without a `colour` it looks like the wall.

    The camera `moves` by pixels.
    """
    rng = np.random.default_rng(0)
    for frame in range(24):
        true, matte = head(70 + round(18 * np.sin(frame)))
        behind = np.roll(wall(), (frame * moves) % 40, axis=(0, 1))
        picture = np.where(true[..., None], behind if colour is None else colour, behind) + NOISE * rng.standard_normal(
            (SIZE, SIZE, 3)
        )
        yield np.rint(picture).clip(0, 255).astype(np.uint8), matte, true


def test_the_background_is_what_stands_behind_and_shows_in_a_gap() -> None:
    plate = learn_plate((image, matte) for image, matte, _ in clip())
    assert plate is not None
    assert NOISE < plate.noise < 2.5 * NOISE
    seen = plate.known & (np.abs(plate.colours - wall()).max(axis=2) < 3 * NOISE)
    assert seen.sum() > 0.97 * plate.known.sum() > 0.4 * SIZE**2
    gaps = found = wrong = 0
    for image, matte, true in clip():
        said = shown(plate, image, matte > 127)
        gap = (
            cv2.erode(((matte > 127) & ~true).astype(np.uint8), np.ones((3, 3))) > 0
        )  # whose surroundings are all of it
        gaps, found, wrong = gaps + gap.sum(), found + (said & gap).sum(), wrong + (said & true).sum()
    assert found > 0.9 * gaps > 0
    assert wrong == 0


def test_a_person_who_looks_like_the_wall_loses_nothing() -> None:
    """Nor is the notch found."""
    plate = learn_plate((image, matte) for image, matte, _ in clip(None))
    assert plate is not None
    for image, matte, _ in clip(None):
        lost = shown(plate, image, matte > 127) & (matte > 127)
        assert not lost[:, SIZE // 2 :].any()  # away from the shelf
        assert lost.sum() < 0.005 * (matte > 127).sum()


def test_a_camera_that_moves_has_no_background() -> None:
    assert learn_plate((image, matte) for image, matte, _ in clip(moves=3)) is None


@pytest.mark.parametrize(
    ("share", "away", "is_still"), [(0.0, 0.0, True), (0.1, 2.8, True), (0.03, 6.0, True), (0.08, 6.0, False)]
)
def test_a_camera_stands_still_where_little_changes(share: float, away: float, is_still: bool) -> None:
    """A lamp flickers: such a share of the background is `away` times the noise brighter, each place in a third of the
    pictures."""
    learned = learn_plate((image, matte) for image, matte, _ in clip())
    assert learned is not None
    lit = np.random.default_rng(0).random((SIZE // 8, SIZE // 8)) < 3 * share
    brighter = away * learned.noise * np.kron(lit, np.ones((8, 8)))[..., None]
    pairs = []
    for number, (image, matte, _) in enumerate(clip()):
        shown = image + brighter if number % 3 == 0 else image
        pairs.append((np.rint(shown).clip(0, 255).astype(np.uint8), matte))
    assert (learn_plate(pairs) is not None) == is_still


def test_too_few_pictures_or_nothing_behind() -> None:
    pairs = [(image, matte) for image, matte, _ in clip()]
    assert learn_plate(pairs[:2]) is None
    assert learn_plate([]) is None
    assert learn_plate([(image, np.full_like(matte, 255)) for image, matte in pairs]) is None
    for columns in range(1, 12):  # of nobody: what is left of them is seen in a single column, of an odd number
        somebody = np.full((SIZE, SIZE), 255, np.uint8)
        somebody[:, SIZE - columns :] = 0
        plate = learn_plate([(image, somebody) for image, _ in pairs])
        assert plate is None or plate.noise >= 1.0


def test_large_pictures_are_learned_at_the_size_at_which_they_are_matted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closed_form_matting, "LARGEST", SIZE // 2)
    pairs = [(image, matte) for image, matte, _ in clip()]
    plate = learn_plate(pairs)
    assert plate is not None and plate.colours.shape == (SIZE // 2, SIZE // 2, 3)
    points = np.array([[30.0, 60.0], [110.0, 140.0]])
    made = sharpened(*pairs[0], points, plate)
    assert made.shape == (SIZE, SIZE) and made.dtype == np.uint8


@pytest.mark.slow
def test_mattes_of_a_demo_person_come_nearer_to_the_truth() -> None:
    """By a network that knows the outline to a pixel of 96 and closes its gaps."""
    size, seed = 384, 1
    renderer, performance, rng = Renderer(sample_identity(seed)), perform(seed, 240, "speech"), np.random.default_rng(0)
    pairs, truth, points = [], [], []
    for frame in range(0, 240, 20):
        picture = renderer.render(frame_params(performance, frame), frame_camera(performance, frame, size))
        share = picture.alpha[..., None] / 255.0
        image = expose(picture.image * share + make_room(size, seed) * (1 - share), rng)
        small = cv2.resize(picture.alpha, (96, 96), interpolation=cv2.INTER_AREA)
        small = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((5, 5)))
        pairs.append((image, cv2.resize(small, (size, size))))
        truth.append(picture)
        mouth = np.argwhere(picture.mouth > 127)[:, ::-1]
        points.append(np.stack((mouth.min(0), mouth.max(0))).astype(float) + np.array([[-40, -90], [40, 30]]))
    plate = learn_plate(pairs)
    assert plate is not None

    def error(behind: object) -> float:
        total = 0.0
        for (image, matte), picture, about in zip(pairs, truth, points, strict=True):
            made = sharpened(image, matte, about, behind)  # type: ignore[arg-type]
            near = cv2.dilate(picture.head, np.ones((9, 9), np.uint8)) > 0
            total += float(np.square(made.astype(float) - picture.alpha)[near].mean())
        return total

    assert error(plate) < 0.85 * error(None)
