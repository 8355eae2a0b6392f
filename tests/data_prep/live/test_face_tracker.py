"""From a video to an avatar that follows, with MediaPipe: the demo's person, whose motion is known."""

from __future__ import annotations

import contextlib
import itertools
import math
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import running
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from small_runs import train_small
from videos import encode

from avatar.demo.performance import perform
from avatar.demo.raw_video import filmed
from avatar.demo.subject import make_subject
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.head.model import matrix_from_6d
from data_prep.live import face_tracker
from data_prep.live.face_tracker import LiveFaceTracker
from data_prep.live.picture_sources import LivePicture, VideoFile
from data_prep.track.fit.fit_clip import find_embedding
from data_prep.track.footage.picture_folder import open_footage

pytestmark = [pytest.mark.usefixtures("tracking_models"), pytest.mark.slow]
FRAMES, SIZE, SEED, FPS = 48, 192, 1, 10.0


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return list(filmed(FRAMES, SIZE, SEED))


@pytest.fixture(scope="module")
def video(pictures: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return encode(tmp_path_factory.mktemp("video") / "me.mp4", pictures, fps=FPS)


@pytest.fixture(scope="module")
def head(demo_head_model: Path, tracking_models: None) -> Path:
    """The demo's head with its landmarks in the cache, which other tests of the session use too."""
    find_embedding(demo_head_model, load_head_assets(demo_head_model))
    return demo_head_model


class EveryPicture(LiveFaceTracker):
    """Follows a video whose next picture comes when it is asked for: a busy machine drops and delays none."""

    def __init__(self, video: Path, head: Path, say: Callable[[str], object], fov: float | None = None) -> None:
        asked, clock = threading.Semaphore(0), itertools.count()

        def now() -> float:
            assert asked.acquire(timeout=60)
            return next(clock) / FPS

        super().__init__(VideoFile(open_footage(video), now), load_head_assets(head), head, say, fov)
        take = self.pictures.take

        def ask() -> LivePicture:
            asked.release()
            return take()

        self.pictures.take = ask


def test_the_mouth_is_followed(video: Path, head: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(face_tracker, "CALIBRATION_SECONDS", 2.0)
    said: list[str] = []
    with contextlib.closing(EveryPicture(video, head, said.append)) as follower:
        with pytest.raises(RuntimeError, match="comes after calibrate"):
            follower.follow()
        calibration = follower.calibrate(said.append)
        assert said[-2:] == ["Look into the camera, calmly, lips closed.", "Fitting the face."]
        assert len(calibration.faces) >= face_tracker.FEWEST and calibration.identity.shape == (300,)
        assert float(calibration.identity.abs().max()) < 5
        assert calibration.faces[0].taken == 0
        frames, opened = [], []
        with pytest.raises(UserError, match=f"me.mp4 has ended after {FRAMES} pictures"):
            while True:
                face = follower.follow()
                assert face is not None
                frames.append(round(face.taken * FPS))
                opened.append(float(rotation_matrix_to_axis_angle(matrix_from_6d(face.params.jaw)[None])[0, 0]))
        assert frames == list(range(21, FRAMES)), "2 seconds of calibration, then every picture"
    truth = perform(SEED, FRAMES, "speech").jaw[frames]
    assert np.abs(np.array(opened) - truth).mean() < 0.06
    assert 0 < follower.milliseconds["fit"] < 1000 and follower.dropped() == (0, FRAMES)


def test_the_field_of_view_says_how_far_the_face_is(video: Path, head: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(face_tracker, "CALIBRATION_SECONDS", 1.0)
    distances = []
    for degrees in (15.0, 30.0):
        with contextlib.closing(EveryPicture(video, head, print, degrees)) as follower:
            faces = follower.calibrate(lambda _: None).faces
        distances.append(float(np.median([float(face.t_cam_head[2]) for face in faces])))
    expected = math.tan(math.radians(15.0)) / math.tan(math.radians(7.5))
    assert distances[0] / distances[1] == pytest.approx(expected, rel=0.1)
    with pytest.raises(UserError, match="--fov must be from 1 to 150 degrees"):
        EveryPicture(video, head, print, 180.0)


def test_a_video_that_is_too_short_to_calibrate(video: Path, head: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(face_tracker, "CALIBRATION_SECONDS", 60.0)
    follower = EveryPicture(video, head, print)
    with pytest.raises(UserError, match=r"has ended.*; 48 pictures showed the face, calibration takes 20 and 60 s"):
        follower.calibrate(lambda _: None)
    follower.close()


def test_a_picture_without_a_face(tmp_path: Path, head: Path) -> None:
    grey = encode(tmp_path / "grey.mp4", [np.full((96, 96, 3), 90, np.uint8)] * 4, fps=25)
    said: list[str] = []
    follower = EveryPicture(grey, head, print)
    with pytest.raises(UserError, match="has ended after 4 pictures; 0 pictures showed the face"):
        follower.calibrate(said.append)
    assert said == [face_tracker.NO_FACE]
    follower.close()
    follower.close()


def test_the_command_follows_a_video_to_its_end(pictures: list[np.ndarray], head: Path, tmp_path: Path) -> None:
    pytest.importorskip("viser")
    video = encode(tmp_path / "me.mp4", pictures, fps=FPS / 2)  # a busy machine has the time for enough of them
    make_subject(tmp_path / "subject", frames=12, size=64, seed=2)
    train_small(tmp_path / "subject", tmp_path / "run", ["trainer.iterations=4", "model.uv_size=16"])
    words = ["view", tmp_path / "run", "--head", head, "--webcam", video, "--port", "0", "--size", "64"]
    with running(*words, until="has ended") as (process, said):
        assert f"Webcam   {video}, {SIZE} x {SIZE} pixels" in said and "Open     http://127.0.0.1:" in said
        assert "Webcam   Calibrated: the avatar follows." in said
        assert f"{video} has ended after {FRAMES} pictures" in said
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 130


UNCLOSED = """
import gc
import numpy
from data_prep.track.faces.detect import FaceDetector
for _ in range(3):
    detector = FaceDetector()
    detector.itself = detector
    detector.find(numpy.random.default_rng(0).integers(0, 255, (200, 200, 3)).astype(numpy.uint8))
    del detector
    gc.collect()
"""


def test_a_detector_that_nobody_closed_does_not_wait_forever(tracking_models: None) -> None:
    ended = subprocess.run([sys.executable, "-c", UNCLOSED], timeout=60, check=False)
    assert ended.returncode == 0
