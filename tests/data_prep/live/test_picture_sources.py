"""Pictures that come now: at their own rate, the newest one first, and every end said in a sentence."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from videos import encode, spot
from waiting import until

from avatar.errors import UserError
from data_prep.live.picture_sources import FILMED, FOLLOWED, Camera, LivePicture, Newest, VideoFile, open_source
from data_prep.track.footage.picture_folder import open_footage

WIDTH, HEIGHT = 80, 64
BLANK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


class Scripted:
    """A source whose pictures the test gives, one for each call of `give`."""

    name, size, equivalent_focal, silent_after = "a script", (WIDTH, HEIGHT), None, 5.0

    def __init__(self, count: int, error: Exception | None = None) -> None:
        self._count, self._error = count, error
        self._may_go = threading.Semaphore(0)
        self.is_closed = False

    def give(self, count: int = 1) -> None:
        for _ in range(count):
            self._may_go.release()

    def pictures(self) -> Iterator[LivePicture]:
        for n in range(self._count):
            self._may_go.acquire(timeout=10)
            yield LivePicture(BLANK, float(n))
        self._may_go.acquire(timeout=10)
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        self.is_closed = True
        self.give(self._count + 1)


class Capture:
    """What OpenCV's VideoCapture does, for a camera that gives `count` pictures."""

    def __init__(self, count: int) -> None:
        self.left, self.is_released = count, False
        self.settings: dict[int, float] = {}

    def isOpened(self) -> bool:
        return self.left > 0

    def set(self, what: int, value: float) -> bool:
        self.settings[what] = value
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.left -= 1
        picture = BLANK.copy()
        picture[..., 0] = 200  # blue comes first
        return (True, picture) if self.left >= 0 else (False, None)

    def release(self) -> None:
        self.is_released = True


def test_a_slow_reader_gets_the_newest_picture() -> None:
    source = Scripted(10)
    newest = Newest(source)
    newest.start()
    source.give(7)
    until(lambda: newest.read == 7)
    assert newest.take().taken == 6.0 and newest.dropped == 6
    source.give()
    assert newest.take().taken == 7.0 and newest.dropped == 6, "it is waited for, and what was taken is not dropped"
    newest.close()
    assert source.is_closed


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (None, "a script has ended after 2 pictures"),
        (UserError("the cable is out"), "the cable is out"),
        (ValueError("what"), r"a script breaks off \(what\)"),
    ],
)
def test_every_end_is_told_after_the_last_picture(error: Exception | None, sentence: str) -> None:
    source = Scripted(2, error)
    newest = Newest(source)
    newest.start()
    source.give(3)
    until(lambda: newest._end is not None)
    assert newest.take().taken == 1.0
    for _ in range(2):
        with pytest.raises(UserError, match=f"^{sentence}$"):
            newest.take()


class Hanging(Scripted):
    """Gives nothing, and does not end when it is closed."""

    def pictures(self) -> Iterator[LivePicture]:
        self._may_go.acquire(timeout=10)
        yield from ()

    def close(self) -> None:
        self.is_closed = True


@pytest.mark.slow
def test_who_waits_for_a_source_that_hangs_is_told() -> None:
    source = Hanging(0)
    source.silent_after = 0.05
    newest = Newest(source)
    newest.start()
    with pytest.raises(UserError, match="a script has given no picture for 0 s"):
        newest.take()
    source.silent_after = 8.0
    told: list[str] = []

    def wait() -> None:
        try:
            newest.take()
        except UserError as error:
            told.append(str(error))

    waiting = threading.Thread(target=wait)
    waiting.start()
    newest.close()
    waiting.join(5)
    assert told == ["a script is closed"]
    source.give()


def test_a_camera_that_dies() -> None:
    capture = Capture(3)
    camera = Camera(2, lambda number: capture)  # type: ignore[arg-type, return-value]
    assert camera.size == (WIDTH, HEIGHT) and camera.name == "camera 2"
    pictures = camera.pictures()
    first = next(pictures)
    assert first.image[0, 0].tolist() == [0, 0, 200], "red, green, blue"
    assert abs(first.taken - time.monotonic()) < 1
    next(pictures)
    with pytest.raises(UserError, match="camera 2 gives no pictures any more"):
        next(pictures)
    assert capture.is_released


def test_a_camera_is_released_before_its_first_picture_and_after_one() -> None:
    for read in (0, 1):
        capture = Capture(5)
        newest = Newest(Camera(2, lambda number, of=capture: of))  # type: ignore[arg-type, return-value, misc]
        pictures = newest.source.pictures()
        for _ in range(read):
            next(pictures)
        newest.close()
        assert capture.is_released == (read == 0), "a picture may be being read"
        assert list(pictures) == [] and capture.is_released


def test_a_camera_is_set_to_what_it_is_for() -> None:
    for settings in (FOLLOWED, FILMED):
        capture = Capture(3)
        Camera(0, lambda number, of=capture: of, settings)  # type: ignore[arg-type, return-value, misc]
        assert capture.settings == settings
    assert next(iter(FILMED)) == cv2.CAP_PROP_FOURCC, "sizes are those of the format"


def test_a_camera_that_is_missing() -> None:
    capture = Capture(0)
    with pytest.raises(UserError, match="camera 3 gives no picture.*is missing, in use"):
        Camera(3, lambda number: capture)  # type: ignore[arg-type, return-value]
    assert capture.is_released
    with pytest.raises(UserError, match="camera 97 gives no picture"):
        open_source("97")


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pictures = [spot(10 + 3 * n, 30, WIDTH, HEIGHT) for n in range(12)]
    return encode(tmp_path_factory.mktemp("video") / "spot.mp4", pictures, fps=20)


class Hand:
    """A clock that goes on only while somebody waits."""

    now = 100.0

    def wait(self, seconds: float) -> bool:
        self.now += seconds
        return False


def test_a_video_is_played_at_its_own_rate(video: Path) -> None:
    hand = Hand()
    played = VideoFile(open_footage(video), lambda: hand.now)
    assert played.size == (WIDTH, HEIGHT)
    played._closed = hand  # type: ignore[assignment]
    seen = [(picture.taken, hand.now) for picture in played.pictures()]
    np.testing.assert_allclose(seen, [(100 + n / 20,) * 2 for n in range(12)], rtol=0, atol=1e-6)


def test_a_decoder_that_is_late_makes_no_old_pictures(video: Path) -> None:
    seconds = iter(range(100, 200))
    played = VideoFile(open_footage(video), lambda: float(next(seconds)))
    assert [picture.taken for picture in played.pictures()] == [100.0 + n for n in range(12)]


def test_a_video_is_left_at_once(tmp_path: Path) -> None:
    a_minute = encode(tmp_path / "minute.mp4", [BLANK] * 60, fps=1)
    played = open_source(str(a_minute))
    newest = Newest(played)
    newest.start()
    newest.take()
    newest.close()
    assert newest.read < 60 and not newest._thread.is_alive()


def test_a_video_that_is_cut_off_says_so(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = encode(tmp_path / "x.avi", [rng.integers(0, 256, BLANK.shape).astype(np.uint8) for _ in range(60)], fps=20)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 3])
    with pytest.raises(UserError, match="x.avi has ended: .*(damaged|its pictures end after)"):
        list(open_source(str(path)).pictures())


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("gone.mp4", None, "does not exist"),
        ("empty.mp4", b"", "is empty"),
        ("nonsense.mp4", b"nonsense" * 100, "is not a video that ffmpeg can read"),
    ],
)
def test_a_video_that_cannot_be_read(name: str, content: bytes | None, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=sentence):
        open_source(str(path))
