"""Training in rounds on folders of several cameras, as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_rig_folder import write_single
from command_line import avatar
from small_runs import SMALL

from avatar.pipeline import refine_plan

pytestmark = pytest.mark.slow

QUICK = [*SMALL, "trainer.iterations=10"]


@pytest.mark.parametrize("cameras", ["12", "07,12", "front"])
def test_some_of_several_cameras_are_trained_on_in_rounds(
    cameras: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, run = write_single(tmp_path), tmp_path / "run"
    monkeypatch.setattr(refine_plan, "FIRST_STEPS", 4)
    words = ("--head", tmp_path / "head_model", "--cameras", cameras, "--refine", 1)
    assert "10/10" in avatar("train", folder, "--out", run, *words, *QUICK)
    assert "is complete" in avatar("train", "--resume", "--out", run, "--cameras", cameras)


def test_cameras_of_unlike_sizes_are_refined(tmp_path: Path) -> None:
    """The pictures of what is held out are of both sizes."""
    folder, run = write_single(tmp_path), tmp_path / "run"
    for listing in folder.glob("transforms_*.json"):
        content = json.loads(listing.read_text())
        for entry in content["frames"]:
            if entry["camera_id"] == "07":
                entry.update({key: 1.5 * entry[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")})
        listing.write_text(json.dumps(content))
    for path in folder.glob("*/*_07.png"):
        image = cv2.imread(str(path))
        assert image is not None and cv2.imwrite(str(path), np.asarray(cv2.resize(image, (96, 84))))
    avatar("train", folder, "--head", tmp_path / "head_model", "--out", run, "data.test_cameras=07", *QUICK)
    assert "6/6" in avatar("refine", run)
    sheet = cv2.imread(str(run / "refined" / "EMO" / "refinement.png"))
    assert sheet is not None and sheet.shape[1] == 5 * 96
