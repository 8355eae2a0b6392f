"""Tracking without MediaPipe and without a fit, for what comes before it; recordings by several cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from marked_face import MarkDetector
from rig_recording import write_plain_gha, write_plain_raw

from data_prep.formats.frame_track import FrameTrack
from data_prep.track import track as tracking
from data_prep.track.fit.result import Clip, Fit
from data_prep.track.quality import Quality


@pytest.fixture
def with_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of tracking but the fit and what needs models."""

    def fitted(clip: Clip, *_: object) -> Fit:
        values = {"expression": 2, "jaw": 6, "eyes": 12, "eyelids": 2, "neck": 6, "t": 3, "shape": 2}
        one = {name: np.zeros(count) for name, count in values.items()}
        made = FrameTrack(**one, R=np.eye(3), intrinsics=np.array(clip.intrinsics), size=clip.landmarks.size)
        return Fit(dict.fromkeys(np.flatnonzero(clip.landmarks.detected).tolist(), made), {})

    for module in ("track", "first_pass"):
        monkeypatch.setattr(f"data_prep.track.{module}.FaceDetector", MarkDetector)
    monkeypatch.setattr("data_prep.track.tracking_stages.fit_tracks", fitted)
    monkeypatch.setattr(tracking.TrackingStages, "masks", lambda *_: ([1.0], None))
    monkeypatch.setattr(tracking.TrackingStages, "torso", lambda _, fit: fit)
    monkeypatch.setattr(tracking.TrackingStages, "overlay", lambda *_: None)
    monkeypatch.setattr(tracking, "grade_tracking", lambda *_: Quality((), (), ""))


@pytest.fixture(scope="session")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in NeRSemble's layout; do not write into it."""
    return write_plain_raw(tmp_path_factory.mktemp("raw"))


@pytest.fixture(scope="session")
def gha(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same in GaussianHeadAvatar's layout; do not write into it."""
    return write_plain_gha(tmp_path_factory.mktemp("gha") / "someone")
