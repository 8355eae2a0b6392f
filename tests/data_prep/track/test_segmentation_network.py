"""MediaPipe's segmentation networks."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from data_prep.track.mattes import segmentation_network


def test_the_mirror_image_has_a_say() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[:, 0] = 200

    def leans_left(picture: np.ndarray) -> np.ndarray:
        answer = picture[..., 0].copy()
        answer[:, 1] = 100
        return answer

    row = segmentation_network._with_mirrored(leans_left)(image)[0]
    np.testing.assert_array_equal(row, [200, 50, 0, 0, 50, 0])


def test_networks_are_loaded_one_after_another(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two at once made OpenCV 5.0 find operators unsupported, or end the process."""
    loading = []

    def load(_: str) -> None:
        loading.append(1)
        time.sleep(0.05)
        assert len(loading) == 1
        loading.pop()

    monkeypatch.setattr(segmentation_network.cv2.dnn, "readNetFromTFLite", load)
    monkeypatch.setattr(segmentation_network, "require", lambda _: tmp_path / "network.tflite")
    with ThreadPoolExecutor(4) as pool:
        assert len(list(pool.map(lambda _: segmentation_network._segmentation(), range(4)))) == 4
