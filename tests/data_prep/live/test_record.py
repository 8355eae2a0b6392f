"""avatar record: what is said and written, of a drawn person that does as the test wants, and of a video with MediaPipe."""

from __future__ import annotations

import os
import signal
import threading
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from command_line import avatar, running
from posing import HEIGHT, WIDTH, picture, posed
from videos import encode

from avatar.commands import record
from avatar.demo.raw_video import filmed
from avatar.errors import UserError
from data_prep.live.picture_sources import FILMED, LivePicture
from data_prep.live.recording_guidance import ENDS, PROMPTS
from data_prep.track.faces.detect import Face

FPS = 5
WAITED = 2.2  # seconds before the film: the rate is measured
SHARP, DIM, BLURRED = picture(), picture(light=0.4), picture(blur=8.0)

Play = Callable[[float], tuple[np.ndarray, Face | None]]


class StandIn:
    """A camera and what finds the faces: its next picture is taken when the last one has been looked at."""

    name, size, equivalent_focal, silent_after = "a stand-in", (WIDTH, HEIGHT), None, 5.0

    def __init__(self, play: Play, times: Sequence[float]) -> None:
        self._play, self._times = play, times
        self._face: Face | None = None
        self._looked = threading.Semaphore(1)

    def pictures(self) -> Iterator[LivePicture]:
        for time in self._times:
            self._looked.acquire(timeout=10)
            image, self._face = self._play(time - WAITED)
            yield LivePicture(image, 100 + time)
        self._looked.acquire(timeout=10)

    def find(self, image: np.ndarray) -> list[Face]:
        face = self._face
        self._looked.release()
        return [] if face is None else [face]

    def close(self) -> None:
        self._looked.release()

    def __enter__(self) -> StandIn:
        return self

    def __exit__(self, *error: object) -> None:
        pass


@pytest.fixture
def filming(monkeypatch: pytest.MonkeyPatch) -> Callable[..., StandIn]:
    """Puts a person before the camera of the command."""

    def put(play: Play, seconds: float = 63.0, gone: slice = slice(0)) -> StandIn:
        stand_in = StandIn(play, np.delete(np.arange(0, seconds, 1 / FPS), gone).tolist())
        monkeypatch.setattr(record, "FaceDetector", lambda: stand_in)
        monkeypatch.setattr(record, "open_source", lambda given, settings: stand_in)
        return stand_in

    return put


def number_of(word: str) -> int:
    return next(n for n, prompt in enumerate(PROMPTS) if word in prompt.words)


def obedient(time: float) -> Face:
    """Does what is asked, but does not smile and turns to the right too little."""
    doing = (
        {},
        {"jawOpen": 0.6},
        {"mouthSmileLeft": 0.2},
        {"browInnerUp": 0.9},
        {"eyeBlinkLeft": 0.6, "eyeBlinkRight": 0.6},
        {"eyeLookOutLeft": 0.7} if time % 2 < 1 else {"eyeLookInLeft": 0.7},
        {"eyeLookUpLeft": 0.3} if time % 2 < 1 else {"eyeLookDownLeft": 0.7},
        {"yaw": 31.0},
        {"yaw": -12.0},
        {"pitch": 14.0 if time % 2 < 1 else -14.0},
        {"jawOpen": 0.3},
        {},
    )
    return posed(**doing[bisect_right(ENDS, max(time, 0.0))])


@pytest.mark.slow
def test_prompts_advice_and_what_was_reached(filming: Callable[..., StandIn], tmp_path: Path) -> None:
    def play(time: float) -> tuple[np.ndarray, Face | None]:
        prompt = bisect_right(ENDS, max(time, 0.0))
        if prompt == number_of("Speak"):
            return BLURRED, obedient(time)
        if prompt == number_of("Close"):
            return SHARP, posed(height=150.0, eyeBlinkLeft=0.6, eyeBlinkRight=0.6)
        return (DIM if prompt == number_of("brows") else SHARP), obedient(time)

    filming(play, gone=slice(150, 155))
    out = tmp_path / "me.mp4"
    lines = avatar("record", out).splitlines()
    assert lines[0].startswith("Camera   a stand-in, 640 x 480 pixels. Ctrl-C")
    first = lines.index(" 1 of 11 Look at the camera calmly, lips closed.")
    told = {4: "more light on the face", 5: "come closer", 11: "hold still"}
    expected = []
    for n, prompt in enumerate(PROMPTS, 1):
        expected += [f"{n:2} of 11 {prompt.words}", *([f"         {told[n]}"] if n in told else [])]
    assert lines[first : first + len(expected)] == expected
    film, *rest = lines[first + len(expected) :]
    assert film == f"Film     {out}"
    assert (
        rest[0].startswith("         60.")
        and "at 5 pictures a second; missing ones repeated: 5, early ones left out: 0" in rest[0]
    )
    assert rest[1].startswith("Picture  1") and rest[1].endswith(" % of the time: hold still")
    judged = {line[9:]: line.split()[0] for line in rest if line.startswith(("Reached", "Repeat"))}
    assert [words.split(".")[0] + "." for words in judged] == [prompt.words for prompt in PROMPTS]
    repeat = {words for words, grade in judged.items() if grade == "Repeat"}
    assert repeat == {
        f"{PROMPTS[number_of('Smile')].words} smile 0.1 of 0.4",
        f"{PROMPTS[number_of('right, and')].words} degrees right 12 of 25",
    }
    assert f"{PROMPTS[number_of('left, and')].words} degrees left 31 of 25" in judged
    assert rest[-1] == f"Next     avatar create {out} --head flame/"
    properties = iio.immeta(out)
    assert properties["fps"] == FPS and properties["size"] == (WIDTH, HEIGHT)
    assert len(iio.imread(out)) == pytest.approx(60 * FPS, abs=2)
    assert [path.name for path in tmp_path.iterdir()] == ["me.mp4"]


def test_a_camera_that_ends_leaves_the_film(filming: Callable[..., StandIn], tmp_path: Path) -> None:
    filming(lambda time: (SHARP, posed()), seconds=12.0)
    lines = avatar("record", tmp_path / "me.mkv").splitlines()
    assert "Stopped: a stand-in has ended after 60 pictures" in lines
    assert f"Repeat   {PROMPTS[-1].words}" in lines, "nobody saw it"
    assert len(iio.imread(tmp_path / "me.mkv")) == pytest.approx((12 - WAITED) * FPS, abs=1)


@pytest.mark.slow
def test_ctrl_c_leaves_the_film(filming: Callable[..., StandIn], tmp_path: Path) -> None:
    looked: list[float] = []

    def play(time: float) -> tuple[np.ndarray, Face | None]:
        looked.append(time)
        return SHARP, posed()

    stand_in = filming(play)
    find = stand_in.find

    def interrupted(image: np.ndarray) -> list[Face]:
        if looked[-1] > 7:
            raise KeyboardInterrupt
        return find(image)

    stand_in.find = interrupted  # type: ignore[method-assign]
    lines = avatar("record", tmp_path / "me.mp4").splitlines()
    assert "Stopped." in lines and lines[-1].startswith("Next     avatar create")
    assert len(iio.imread(tmp_path / "me.mp4")) == pytest.approx(7 * FPS, abs=2)


def test_a_slow_camera_is_written_at_its_rate(filming: Callable[..., StandIn], tmp_path: Path) -> None:
    """That slows down in the dark: its pictures are repeated, and it is said why."""
    filming(lambda time: (SHARP, posed()), seconds=22.0, gone=slice(30, 110, 2))
    said = avatar("record", tmp_path / "me.mp4")
    assert "at 5 pictures a second" in said and "; more light: cameras slow down in the dark" in said
    assert len(iio.imread(tmp_path / "me.mp4")) == pytest.approx(20 * FPS, abs=2)


def test_the_film_begins_with_a_face(filming: Callable[..., StandIn], tmp_path: Path) -> None:
    filming(lambda time: (SHARP, None), seconds=4.0)
    said = avatar("record", tmp_path / "me.mp4", status=1)
    assert "There is no face in the picture." in said
    assert (
        "avatar: a stand-in has ended after 20 pictures; nothing was filmed: that begins with a face, after 2 s" in said
    )
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_full_is_a_sentence(
    filming: Callable[..., StandIn], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filming(lambda time: (SHARP, posed()), seconds=12.0)
    monkeypatch.setattr("avatar.files.video._codec", lambda *of: ["-c:v", "libx264", "-fs", "10", "-f", "nonsense"])
    said = avatar("record", tmp_path / "me.mp4", status=1)
    assert said.splitlines()[-1].startswith(f"avatar: the video {tmp_path / 'me.mp4'} cannot be written (")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("there.mp4", "there.mp4 exists already; give another name, or remove it"),
        ("me.avi", "a film is written as .mp4 or .mov or .mkv, not as me.avi"),
        ("me.mp4 --webcam 97", "camera 97 gives no picture"),
        ("me.mp4 --webcam gone.mp4", "gone.mp4 does not exist"),
    ],
)
def test_what_cannot_be_filmed_is_a_sentence(
    words: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(record, "FaceDetector", lambda: StandIn(lambda time: (SHARP, None), []))
    (tmp_path / "there.mp4").write_bytes(b"dear to somebody")
    assert f"avatar: {sentence}" in avatar("record", *words.split(), status=1).splitlines()[-1]
    assert (tmp_path / "there.mp4").read_bytes() == b"dear to somebody" and len(list(tmp_path.iterdir())) == 1


def test_without_models_nothing_is_filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise UserError("face_landmarker.task is missing: run avatar models --download")

    monkeypatch.setattr(record, "FaceDetector", missing)
    monkeypatch.setattr(record, "open_source", lambda *of: pytest.fail("the camera is opened"))
    assert "face_landmarker.task is missing" in avatar("record", tmp_path / "me.mp4", status=1)


def test_a_camera_is_asked_for_large_pictures(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[object] = []
    monkeypatch.setattr(record, "FaceDetector", lambda: StandIn(lambda time: (SHARP, None), []))

    def refuse(given: str, settings: object) -> None:
        asked.extend((given, settings))
        raise UserError("no")

    monkeypatch.setattr(record, "open_source", refuse)
    avatar("record", tmp_path / "me.mp4", "--webcam", "2", status=1)
    assert asked == ["2", FILMED]


@pytest.mark.slow
def test_a_video_is_filmed_until_ctrl_c(tracking_models: None, tmp_path: Path) -> None:
    """In a terminal of its own, whose Ctrl-C reaches the encoder as well."""
    pictures = [*filmed(30, 288, 1)]
    film = encode(tmp_path / "camera.mp4", [*pictures, *pictures[::-1]] * 6, fps=10)
    out = tmp_path / "me.mp4"
    words = ["record", out, "--webcam", film]
    with running(*words, until="Say a sentence", start_new_session=True) as (process, said):
        os.killpg(process.pid, signal.SIGINT)
        rest, _ = process.communicate(timeout=60)
    assert process.returncode == 0 and "Stopped." in rest
    assert "         come closer\n" in said
    assert 40 <= len(iio.imread(out)) <= 70 and iio.immeta(out)["fps"] == 10
