"""Colours corrected by NeRSemble's matrices: the polynomial, pictures, recordings, and what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rig_recording import FILMED, tinted, write_plain_raw
from videos import LOSSLESS, encode

from avatar.errors import UserError
from data_prep.track.camera_rig import recording
from data_prep.track.camera_rig.recording import COLOURS
from data_prep.track.footage.colour_corrected import TERMS, augmented, correct_colours
from data_prep.track.footage.source import Footage, Span, whole

SERIALS = list(FILMED)
SIX = "R G B RG RB GB"
NINE = f"{SIX} RR GG BB"
CUBIC = f"{NINE} RGB RRG GGB BBR"
MIXED = f"{CUBIC} RRB GGR BBG"
CUBES = "RRR GGG BBB"
PRODUCTS = [
    "R G B",
    "R G B 1",
    "R G B RGB 1",
    f"{SIX} 1",
    f"{SIX} RGB 1",
    f"{NINE} 1",
    f"{NINE} RGB 1",
    f"{NINE} RGB {CUBES} 1",
    f"{CUBIC} {CUBES}",
    f"{CUBIC} {CUBES} 1",
    f"{MIXED} {CUBES}",
    f"{MIXED} {CUBES} 1",
    f"{MIXED} {CUBES} RRGB RGGB RGBB",
]
MIX = np.array([[0.8, 0.1, 0.0], [0.05, 0.75, 0.05], [0.0, 0.1, 0.7]])
CORRECTIONS: dict[str, tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]] = {
    SERIALS[0]: (MIX, lambda x: x @ np.linalg.inv(MIX).T),
    SERIALS[1]: (np.c_[0.9 * np.eye(3), [-0.02] * 3], lambda x: (x + 0.02) / 0.9),
    SERIALS[2]: (
        np.c_[0.6 * np.eye(3), np.zeros((3, 3)), 0.3 * np.eye(3), np.zeros(3)],  # 0.6 x + 0.3 x^2
        lambda x: (np.sqrt(0.36 + 1.2 * x) - 0.6) / 0.6,
    ),
}
"""By serial the matrix, and what inverts it."""


@pytest.mark.parametrize(
    "wanted",
    [[0.5, 0.25, 0.2], [0.5, 0.25, 0.2, 0.125, 0.1, 0.05, 0.25, 0.0625, 0.04, 0.025, 1.0]],
    ids=["3", "11"],
)
def test_terms_of_a_colour(wanted: list[float]) -> None:
    assert augmented(np.array([[0.5], [0.25], [0.2]]), len(wanted))[:, 0] == pytest.approx(wanted, abs=1e-15)


def test_every_number_of_terms() -> None:
    colours = np.random.default_rng(0).random((3, 20))
    factors = dict(zip("RGB1", [*colours, np.ones(20)], strict=True))
    assert [*TERMS] == [len(products.split()) for products in PRODUCTS]
    for products in PRODUCTS:
        wanted = [np.prod([factors[letter] for letter in product], axis=0) for product in products.split()]
        assert np.abs(augmented(colours, len(wanted)) - wanted).max() < 1e-12


def test_correct_colours_is_rounded_and_clipped() -> None:
    """sRGB's values of 0.5 and 0.2 are 187.52 and 123.56."""
    image = np.array([[[255, 0, 255]]], np.uint8)
    for matrix, wanted in (
        ([[0.5, 0, 0, 0], [0, 1, 0, 0.2], [0, 0, -1, 0]], [188, 124, 0]),
        ([[2, 0, 0, 0], [0, 1, 0, -1e-3], [0, 0, 0.003, 0]], [255, 0, 10]),
    ):
        assert correct_colours(image, np.array(matrix))[0, 0].tolist() == wanted


@pytest.mark.parametrize("count", TERMS)
def test_the_identity_leaves_a_picture_as_it_is(count: int) -> None:
    image = np.random.default_rng(count).integers(0, 256, (150, 101, 3), np.uint8)
    assert np.array_equal(correct_colours(image, np.eye(3, count)), image)


@pytest.fixture(scope="module")
def truth() -> list[np.ndarray]:
    return [np.random.default_rng(n).integers(90, 160, (64, 64, 3), np.uint8) for n in range(2)]


@pytest.fixture
def sequence(truth: list[np.ndarray], tmp_path: Path) -> Path:
    """A recording whose cameras see the same pictures in other colours."""
    folder = write_plain_raw(tmp_path)
    for serial, (_, undo) in CORRECTIONS.items():
        pictures = [tinted(picture, undo) for picture in truth]
        encode(folder / "images" / f"cam_{serial}.mp4", pictures, options=LOSSLESS)
    write_matrices(folder, {serial: matrix.tolist() for serial, (matrix, _) in CORRECTIONS.items()})
    return folder


def write_matrices(folder: Path, content: object) -> None:
    (folder.parent.parent / COLOURS).write_text(json.dumps(content))


def off(footage: Footage, truth: list[np.ndarray]) -> int:
    """Levels by which a colour is off at most."""
    pictures = footage.read(whole(64, 64), Span(), lambda _: None)
    pairs = zip(pictures, truth, strict=True)
    return max(int(np.abs(picture.image.astype(int) - wanted).max()) for picture, wanted in pairs)


def test_a_tinted_recording_gets_its_colours_back(sequence: Path, truth: list[np.ndarray]) -> None:
    corrected = recording.open_recording(sequence).cameras
    assert [off(camera.footage, truth) <= 1 for camera in corrected.values()] == [True] * 3
    (sequence.parent.parent / COLOURS).unlink()
    for camera in recording.open_recording(sequence).cameras.values():
        assert off(camera.footage, truth) > 5 and camera.footage.notes == ()


def test_joined_sequences_get_their_colours_back(sequence: Path, truth: list[np.ndarray]) -> None:
    free = Path(shutil.copytree(sequence, sequence.parent / "FREE"))
    joined = recording.join_recordings([recording.open_recording(folder) for folder in (sequence, free)])
    for camera in joined.cameras.values():
        assert off(camera.footage, truth * 2) <= 1
        assert camera.footage.notes == (f"colours are corrected by {sequence.parent.parent.resolve() / COLOURS}",)


def test_content_hash_changes_with_the_matrix(sequence: Path) -> None:
    def hashes() -> list[str]:
        return [camera.footage.content_hash for camera in recording.open_recording(sequence).cameras.values()]

    first, again = hashes(), hashes()
    write_matrices(sequence, {serial: np.eye(3).tolist() for serial in SERIALS})
    other = hashes()
    (sequence.parent.parent / COLOURS).unlink()
    assert first == again and len({*first, *other, *hashes()}) == 9


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{"a": 1', "cannot be read as JSON"),
        ('{"a": 1, "a": 2}', "a is there twice"),
        ("[]", f"there is nothing on camera {SERIALS[0]}, which has videos"),
        (json.dumps({SERIALS[0]: np.eye(3).tolist()}), f"there is nothing on camera {SERIALS[1]}, which has videos"),
        (json.dumps({SERIALS[0]: "R"}), f"the matrix of camera {SERIALS[0]} is not numbers"),
        (json.dumps({SERIALS[0]: [[1], [2, 3], [4]]}), f"the matrix of camera {SERIALS[0]} is not numbers"),
        (json.dumps({SERIALS[0]: np.full((3, 3), np.inf).tolist()}), f"camera {SERIALS[0]} is not finite"),
        (json.dumps({SERIALS[0]: np.full((3, 4), 1e30).tolist()}), f"camera {SERIALS[0]} holds numbers beyond 1e"),
        (json.dumps({SERIALS[0]: np.eye(4, 3).tolist()}), rf"{SERIALS[0]} has the shape \[4, 3\], not \[3, T\]"),
        (json.dumps({SERIALS[0]: np.eye(3, 6).tolist()}), r"\[3, 6\], not \[3, T\] with T of 3, 4, 5, 7, 8, 10, 11"),
        (json.dumps({SERIALS[0]: [1, 0, 0]}), rf"{SERIALS[0]} has the shape \[3\], not \[3, T\]"),
    ],
)
def test_read_colour_matrices_refuses(content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / COLOURS).parent.mkdir()
    (tmp_path / COLOURS).write_text(content)
    with pytest.raises(
        UserError, match=f"color_calibration.json.*{said}.*; download it again, or remove it"
    ) as refusal:
        recording.read_colour_matrices(tmp_path, SERIALS)
    assert str(refusal.value).startswith(str(tmp_path / COLOURS))
