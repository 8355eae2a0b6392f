"""A video that lies on its side or stands on its head is turned, and so are the mattes that are given for it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from heads import grid_head
from marked_face import HEIGHT, WIDTH, MarkDetector, matte, picture
from videos import LOSSLESS, encode, talking

from avatar.commands.parser import build_parser
from avatar.errors import UserError
from data_prep.formats.avatar_track import read_info
from data_prep.track import track as tracking
from data_prep.track.faces.detect import Face, FaceDetector
from data_prep.track.faces.landmarks import load_landmarks
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.rotated import TURNS, turn_image, turned
from data_prep.track.footage.source import Box, Span, View, whole
from data_prep.track.track import Choices, track
from data_prep.track.upright import find_upright, roll_of, sample_pictures

FRAMES = 12


def lying(turn: int, folder: Path, frames: int = FRAMES) -> Path:
    """A video that is upright once it is turned clockwise by `turn`."""
    pictures = [turn_image(picture(n % 5), -turn % 360) for n in range(frames)]
    return encode(folder / "v.mkv", pictures, options=LOSSLESS)


def write_mattes(turn: int, folder: Path, frames: int = FRAMES) -> Path:
    folder.mkdir()
    for n in range(frames):
        cv2.imwrite(str(folder / f"{n}.png"), turn_image(matte(n % 5), -turn % 360))
    return folder


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("kind", ["video", "folder"])
def test_a_part_of_a_turned_picture_is_that_of_the_picture_turned(turn: int, kind: str, tmp_path: Path) -> None:
    images = [np.random.default_rng(n).integers(0, 256, (80, 120, 3), np.uint8) for n in range(3)]
    if kind == "video":
        path = encode(tmp_path / "v.mkv", images, options=LOSSLESS)
    else:
        path = tmp_path
        for n, image in enumerate(images):
            cv2.imwrite(str(path / f"{n}.png"), image[..., ::-1])
    footage = turned(open_footage(path), turn)
    expected = [turn_image(image, turn) for image in images]
    assert (footage.height, footage.width) == expected[0].shape[:2]
    box = Box(5, 9, 60, 40)
    seen = list(footage.read(View(box, 60, 40), Span(), lambda _: None))
    assert [p.time for p in seen] == pytest.approx([0, 0.04, 0.08])
    for found, image in zip(seen, expected, strict=True):
        np.testing.assert_array_equal(found.image, image[9:49, 5:65])
    halved = next(iter(footage.read(View(box, 30, 20), Span(), lambda _: None)))
    assert halved.image.shape == (20, 30, 3)


def test_clockwise_is_clockwise() -> None:
    image = np.array([[1, 2], [3, 4]], np.uint8)[..., None]
    assert turn_image(image, 90)[..., 0].tolist() == [[3, 1], [4, 2]]


@pytest.mark.parametrize("turn", TURNS)
def test_the_turn_is_found_although_an_upright_face_is_fitted_to_one_upside_down(turn: int) -> None:
    found = find_upright([turn_image(picture(n), -turn % 360) for n in range(8)], MarkDetector().anywhere)
    assert found.turn == turn
    assert [round(roll_of(face)) for face in found.faces if face is not None] == [0] * 8


def test_a_head_that_tilts_is_left_as_it_is() -> None:
    """Only a clip that mostly lies is turned."""

    def tilted(degrees: float) -> list[np.ndarray]:
        shape = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), -degrees, 1.0)
        return [cv2.warpAffine(picture(n), shape, (WIDTH, HEIGHT), borderValue=(90, 90, 90)) for n in range(4)]

    detector = MarkDetector()
    assert find_upright(tilted(38) + tilted(-38), detector.anywhere).turn == 0
    assert find_upright(tilted(0) + tilted(90) + tilted(90)[:2], detector.anywhere).turn == 0
    assert find_upright(tilted(60) + tilted(55), detector.anywhere).turn == 270


def test_few_finds_turn_nothing() -> None:
    empty = [np.full((HEIGHT, WIDTH, 3), 90, np.uint8)] * 7
    assert find_upright(empty, MarkDetector().anywhere).turn == 0
    seen: list[int] = []

    def once(image: np.ndarray) -> Face | None:
        """A face where there is none, at one turn of one picture."""
        seen.append(len(seen))
        return MarkDetector().anywhere(turn_image(picture(), 90)) if len(seen) == 3 else None

    assert find_upright(empty, once).turn == 0


def test_a_turn_that_is_given_is_not_doubted() -> None:
    found = find_upright([picture(n) for n in range(3)], MarkDetector().anywhere, given=90)
    assert found.turn == 90 and [round(roll_of(face)) for face in found.faces if face] == [90] * 3


@pytest.mark.parametrize("has_length", [True, False])
def test_samples_are_from_all_over_the_part_that_is_used(has_length: bool, tmp_path: Path) -> None:
    footage = open_footage(encode(tmp_path / "v.mkv", [picture()] * 100, options=LOSSLESS))
    if not has_length:
        object.__setattr__(footage, "duration", None)
    small = View(whole(WIDTH, HEIGHT).box, 16, 12)
    times = [p.time for p in sample_pictures(footage, Span(1.0, 3.0), small, 4)]
    assert times == pytest.approx([1.25, 1.75, 2.25, 2.75] if has_length else [1.0, 2.0], abs=0.0401)


@pytest.mark.slow
def test_real_landmarks_say_the_turn(tracking_models: None) -> None:
    pictures = talking(2, 160)
    with FaceDetector() as detector:
        for turn in TURNS:
            turned_pictures = [turn_image(image, -turn % 360) for image in pictures]
            assert find_upright(turned_pictures, detector.anywhere).turn == turn


def tracked(folder: Path, video: Path, **choices: Any) -> tuple[Path, list[str]]:
    (folder / "head.npz").touch()
    said: list[str] = []
    out = folder / f"out{len(list(folder.iterdir()))}"
    track(video, out, folder / "head.npz", grid_head(), Choices(crop="none", **choices), say=said.append)
    return out, said


@pytest.mark.parametrize("turn", TURNS)
def test_a_lying_video_is_tracked_upright_with_its_mattes(turn: int, with_marks: None, tmp_path: Path) -> None:
    video, mattes = lying(turn, tmp_path), write_mattes(turn, tmp_path / "mattes")
    out, said = tracked(tmp_path, video, matte=mattes)
    info = read_info(out)
    assert (info.width, info.height) == (WIDTH, HEIGHT) and info.source["turned"] == turn
    assert info.source["rotate"] is None
    lines = [line for line in said if f"turned by {turn} degrees clockwise" in line]
    assert len(lines) == (turn != 0) and sum("turned by" in note for note in info.notes) == (turn != 0)
    frame = cv2.imread(str(out / "frames" / "00003.jpg"))[..., ::-1]
    assert np.abs(frame.astype(int) - picture(3)).mean() < 1
    np.testing.assert_array_equal(cv2.imread(str(out / "matte" / "00003.png"), cv2.IMREAD_GRAYSCALE), matte(3))
    landmarks = load_landmarks(out / "landmarks.npz")
    assert landmarks.points[3, 10, :2] == pytest.approx((73.5, 20.5), abs=0.6)


def test_rotate_overrides_and_crop_and_lens_are_of_the_turned_picture(with_marks: None, tmp_path: Path) -> None:
    video = lying(90, tmp_path)
    mattes = write_mattes(90, tmp_path / "mattes")
    out, said = tracked(tmp_path, video, rotate=90, matte=mattes, field_of_view=40.0)
    info = read_info(out)
    assert info.source["rotate"] == info.source["turned"] == 90
    assert any("turned by 90 degrees clockwise, as --rotate says" in line for line in said)
    assert info.intrinsics[0] == pytest.approx(0.5 * WIDTH / np.tan(np.radians(20)))
    left, said = tracked(tmp_path, video, rotate=0, matte=mattes)
    assert (read_info(left).width, read_info(left).source["turned"]) == (HEIGHT, 0)
    assert not any("turned by" in line for line in said)
    head = tmp_path / "head.npz"
    choices = Choices(crop=Box(40, 0, 120, 100), rotate=90, matte=mattes)
    cropped = track(video, tmp_path / "cropped", head, grid_head(), choices, say=said.append)
    assert cropped.intrinsics[2:] == (WIDTH / 2 - 40, HEIGHT / 2)
    with pytest.raises(UserError, match=f"must lie in the video's {HEIGHT}x{WIDTH} pixels"):
        choices = Choices(crop=Box(40, 0, 120, 100), rotate=0, matte=mattes)
        track(video, tmp_path / "other", head, grid_head(), choices, say=said.append)


def test_another_turn_makes_the_stages_again(with_marks: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupted run that goes on with another --rotate takes over no picture that lies otherwise."""
    video, mattes = lying(0, tmp_path), write_mattes(0, tmp_path / "mattes")
    (tmp_path / "head.npz").touch()

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    keys = []
    for rotate in (None, 0, 180):
        with monkeypatch.context() as patch:
            patch.setattr(tracking.TrackingStages, "fit", stop)
            with pytest.raises(KeyboardInterrupt):
                choices = Choices(crop="none", rotate=rotate, matte=mattes)
                track(video, tmp_path / "out", tmp_path / "head.npz", grid_head(), choices, say=lambda _: None)
        stages = tmp_path / ".out.partial"
        frame = cv2.imread(str(stages / "frames" / "00000.jpg"))[..., ::-1]
        assert np.abs(frame.astype(int) - turn_image(picture(), rotate or 0)).mean() < 1
        keys.append(json.loads((stages / "look" / ".stage.json").read_text())["key"])
    assert len(set(keys)) == 3


def test_the_option_as_it_is_typed(capsys: pytest.CaptureFixture[str]) -> None:
    parser, _ = build_parser()
    command = ["track", "v.mp4", "--out", "o"]
    assert parser.parse_args(command).rotate is None
    assert parser.parse_args([*command, "--rotate", "270"]).rotate == 270
    for wrong in ("45", "-90", "left"):
        with pytest.raises(SystemExit):
            parser.parse_args([*command, "--rotate", wrong])
    assert "--rotate" in capsys.readouterr().err
