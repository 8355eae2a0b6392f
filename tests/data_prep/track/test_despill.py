from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from data_prep.progress import silent
from data_prep.track.frames import frame_file, mask_file
from data_prep.track.mattes.despill import despilled, spill_width
from data_prep.track.stage_folder import StageFolder
from data_prep.track.tracking_stages import DESPILLED, TrackingStages

SIDE, RADIUS = 256, 80
WALL, HAIR = (40, 120, 250), (90, 70, 55)


def scene(
    blur: float, wall: tuple[int, int, int] = WALL, side: int = SIDE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A streaky head before a wall, as a video shows it; the head alone, as it is everywhere; its matte, 0 or 255."""
    x = np.arange(side)[None, :, None]
    head = np.broadcast_to(np.array(HAIR) + 12.0 * np.sin(x / 2.0), (side, side, 3))
    matte = cv2.circle(np.zeros((side, side), np.uint8), (side // 2, side // 2), RADIUS * side // SIDE, 255, -1)
    sharp = np.where(matte[..., None] > 0, head, np.array(wall, float)).astype(np.float32)
    shown = cv2.GaussianBlur(sharp, (0, 0), blur) if blur else sharp
    noise = np.random.default_rng(0).normal(0.0, 2.0, shown.shape)
    return np.clip(np.rint(shown + noise), 0, 255).astype(np.uint8), head, matte


def test_a_blurred_edge_is_measured() -> None:
    image, _, matte = scene(blur=2.0)
    assert 2 <= spill_width([(image, matte)]) <= 5
    twice = scene(blur=4.0, side=2 * SIDE)
    assert spill_width([(twice[0], twice[2])]) in range(4, 10)


def test_a_sharp_edge_a_like_wall_and_a_useless_matte_are_left_alone() -> None:
    image, _, matte = scene(blur=0.0)
    assert spill_width([(image, matte)]) == 0
    like = scene(blur=2.0, wall=(95, 75, 60))
    assert spill_width([(like[0], like[2])]) == 0
    assert spill_width([(image, np.zeros_like(matte)), (image, np.full_like(matte, 255))]) == 0
    assert spill_width([]) == 0


def test_the_walls_colour_is_taken_out_and_nothing_else_changes() -> None:
    image, head, matte = scene(blur=2.0)
    width = spill_width([(image, matte)])
    made = despilled(image, matte, width)
    depth = cv2.distanceTransform(matte, cv2.DIST_L2, 5)
    rim = (depth > 0) & (depth <= 3)
    before, after = (np.abs(pixels - head)[rim].mean() for pixels in (image.astype(float), made.astype(float)))
    assert before > 20 and after < before / 4
    blue = (made.astype(float) - head)[rim][:, 2]
    assert abs(blue.mean()) < 4  # no fringe of either sign
    untouched = (matte == 0) | (depth > width + 2)
    assert np.array_equal(made[untouched], image[untouched])


@pytest.mark.parametrize("blur", [0.0, 2.0])
def test_the_stage_writes_frames_only_where_they_get_better(tmp_path: Path, blur: float) -> None:
    image, _, matte = scene(blur)
    for kind, path, pixels in (
        ("frames", frame_file, cv2.cvtColor(image, cv2.COLOR_RGB2BGR)),
        ("matte", mask_file, matte),
    ):
        (tmp_path / kind).mkdir()
        for number in (3, 5):
            cv2.imwrite(str(path(tmp_path / kind, number)), pixels)
    head = SimpleNamespace(faces=torch.zeros(1, 3, dtype=torch.long))
    work = TrackingStages(StageFolder(tmp_path), None, None, head, silent)  # type: ignore[arg-type]
    landmarks = SimpleNamespace(detected=np.array([0, 0, 0, 1, 0, 1], bool))
    width = work.despill(landmarks, ["key"])  # type: ignore[arg-type]
    assert (width > 0) == (blur > 0) and work.despill(landmarks, ["key"]) == width  # type: ignore[arg-type]
    written = sorted(path.name for path in (tmp_path / DESPILLED).glob("*.jpg"))
    assert written == (["00003.jpg", "00005.jpg"] if blur else [])
    if blur:
        shown = cv2.cvtColor(cv2.imread(str(tmp_path / DESPILLED / written[0])), cv2.COLOR_BGR2RGB)
        expected = despilled(
            cv2.cvtColor(cv2.imread(str(tmp_path / "frames/00003.jpg")), cv2.COLOR_BGR2RGB), matte, width
        )
        assert np.abs(shown.astype(float) - expected).mean() < 1.5
