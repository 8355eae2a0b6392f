"""The landmarks' places on a head model, once they are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from heads import grid_head

from data_prep.track.faces.embedding import LandmarkEmbedding
from data_prep.track.faces.rendered_embedding import cached_embedding, rendered_embedding
from data_prep.track.fit import fit_clip


def test_what_is_known_needs_no_landmarker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path))
    head = grid_head()
    assert cached_embedding(head) is None
    made = LandmarkEmbedding(np.array([7]), np.array([[0, 1, 2]]), np.array([[0.5, 0.25, 0.25]]))
    with monkeypatch.context() as patch:
        patch.setattr("data_prep.track.faces.rendered_embedding.make_embedding", lambda *_: made)
        rendered_embedding(head, lambda image: None)
    monkeypatch.setattr(fit_clip, "official_embedding", lambda *_: None)
    monkeypatch.setattr(fit_clip, "FaceDetector", lambda: pytest.fail("the landmarker is loaded"))
    found = fit_clip.find_embedding(tmp_path, head)
    assert found.landmarks.tolist() == [7] and found.barycentric.tolist() == [[0.5, 0.25, 0.25]]
