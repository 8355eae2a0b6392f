"""Reenactment: whose neutral face, through whose lens."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest
import tracked_folder as folders
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.pipeline import reenact as reenact_module


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    avatar("train", tracked_folder, "--frame-offset", 1, "--out", run, *SMALL, "trainer.iterations=4")
    return run


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("drivers") / "driver", frames=8, size=48, seed=5)


def distances(video: Path) -> list[str]:
    return [row["distance"] for row in csv.DictReader(video.with_name(f"{video.stem}.distances.csv").open())]


def test_neutral_faces_can_be_chosen_without_the_training_video(trained: Path, driver: Path, tmp_path: Path) -> None:
    head = driver / "head_model"
    options = ("--driver", driver, "--frame-offset", 1, "--head", head)
    file = trained / "avatar.safetensors"
    output = avatar("reenact", file, *options, "--neutral", 3, "--driver-neutral", "00005", "--out", tmp_path / "a.mp4")
    assert "Neutral expression: frame 00005 of driver, frame 00003 of someone" in output
    recorded = json.loads((tmp_path / "a.choices.json").read_text())
    assert recorded["neutral_frames"] == {"driver": "00005", "avatar": "00003"}
    assert (recorded["choices"]["neutral"], recorded["choices"]["driver_neutral"]) == ("3", "00005")
    avatar("reenact", file, *options, "--neutral", 3, "--driver-neutral", 6, "--out", tmp_path / "b.mp4")
    avatar("reenact", file, *options, "--neutral", 4, "--driver-neutral", 5, "--out", tmp_path / "c.mp4")
    avatar("reenact", file, *options, "--neutral", "00003", "--driver-neutral", 5, "--out", tmp_path / "d.mp4")
    a, b, c, d = (distances(tmp_path / f"{name}.mp4") for name in "abcd")
    assert a == d and a != b and a != c


def test_the_drivers_own_neutral_frame_becomes_the_avatars(trained: Path, driver: Path, tmp_path: Path) -> None:
    """In the frame that was chosen for the driver, the avatar has the face of the frame that was chosen for it."""
    options = ("--driver", driver, "--frame-offset", 1, "--transfer", "relative")
    avatar("reenact", trained, *options, "--neutral", 9, "--driver-neutral", 2, "--out", tmp_path / "a.mp4")
    own = ("--driver", trained_video(trained), "--frame-offset", 1, "--transfer", "raw")
    avatar("reenact", trained, *own, "--out", tmp_path / "raw.mp4")
    assert float(distances(tmp_path / "a.mp4")[1]) == pytest.approx(float(distances(tmp_path / "raw.mp4")[8]), abs=2e-4)


def trained_video(run: Path) -> Path:
    return Path(json.loads((run / "run.json").read_text())["source"]["folder"])


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            ("--neutral", "99"),
            "the training of someone has no frame '99' to choose; there are 00001 to 00024 (24 frames)",
        ),
        (("--neutral", "30"), "the training of someone has no frame '30'"),  # held out
        (("--driver-neutral", "x"), "driver has no frame 'x' to choose; there are 00001 to 00008 (8 frames)"),
        (
            ("--neutral", "3", "--transfer", "raw"),
            "--neutral chooses what --transfer relative or pca measures from; raw",
        ),
        (("--driver-neutral", "3", "--transfer", "mean"), "--driver-neutral chooses what --transfer relative or pca"),
    ],
)
def test_a_neutral_frame_that_cannot_be_is_refused_before_anything_is_drawn(
    trained: Path, driver: Path, tmp_path: Path, options: tuple[str, ...], sentence: str
) -> None:
    video = tmp_path / "out.mp4"
    output = avatar("reenact", trained, "--driver", driver, "--frame-offset", 1, "--out", video, *options, status=1)
    assert sentence in output and not list(tmp_path.iterdir())


def test_open_lips_are_said_of_a_neutral_face_that_was_found_and_not_of_one_that_was_chosen(
    trained: Path, driver: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reenact_module, "lips_apart", lambda *_: 0.0125)
    command = ("reenact", trained, "--driver", driver, "--frame-offset", 1, "--out", tmp_path / "out.mp4")
    sides = {"driver": ("--driver-neutral", 2), "someone": ("--neutral", 3)}
    found = avatar(*command)
    for name, (option, _) in sides.items():
        assert f"The lips of {name} are 12.5 mm apart in the neutral face" in found
        assert f"{option} N takes frame N instead" in found
    for name, choice in sides.items():
        (other,) = sides.keys() - {name}
        said = avatar(*command, *choice)
        assert f"The lips of {other} are" in said and f"The lips of {name} are" not in said


def test_the_help_says_what_a_frame_is_called_by() -> None:
    assert "by its name or number (12 is 00012" in re.sub(r"\s+", " ", avatar("reenact", "--help"))


def test_another_lens_is_warned_of_where_it_shows(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folders, "FOCAL", 1.4)  # half of the avatar's
    other = write_tracked_folder(tmp_path / "other", frames=6, size=48)
    options = ("--driver", other, "--frame-offset", 1, "--out", tmp_path / "out.mp4")
    warned = avatar("reenact", trained, *options)
    assert "Warning: the driver's camera sees 39.3 degrees, the avatar's 20.2" in warned
    assert "--intrinsics target keeps its own lens" in warned
    assert "Warning" not in avatar("reenact", trained, *options, "--intrinsics", "target")
    still = ("--camera", "target", "--intrinsics", "target")
    assert "--intrinsics target changes nothing" in avatar("reenact", trained, *options, *still)
    assert "Warning" not in avatar("reenact", trained, *options, "--camera", "target")


@pytest.mark.parametrize(("longer", "warns"), [(1.09, False), (0.91, False), (1.11, True), (0.89, True)])
def test_a_tenth_of_the_focal_length_is_no_other_lens(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, longer: float, warns: bool
) -> None:
    monkeypatch.setattr(folders, "FOCAL", longer * folders.FOCAL)
    other = write_tracked_folder(tmp_path / "other", frames=4, size=64)  # pictures of another size are not another lens
    output = avatar("reenact", trained, "--driver", other, "--frame-offset", 1, "--out", tmp_path / "out.mp4")
    assert ("Warning: the driver's camera sees" in output) == warns
