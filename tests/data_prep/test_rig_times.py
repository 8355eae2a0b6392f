"""Times of folders with several cameras: which follow each other, and which are neither trained on nor tested."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from camera_rig_folder import AZIMUTHS, edited, opened, write_listings, write_single


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_single(tmp_path_factory.mktemp("rig"))


def test_a_time_that_is_missing_is_no_neighbour(single: Path, tmp_path: Path) -> None:
    folder = edited(single, tmp_path / "copy", lambda entry: entry["timestep_index"] != 2)
    subject, _ = opened(folder, tmp_path / "out")
    assert sorted({record.tracking for record in subject.manifest.frames}) == [0, 1, 3, 4, 5]


def test_times_are_in_order_where_a_camera_lacks_one(single: Path, tmp_path: Path) -> None:
    """With a folder for each camera, whose pictures come one camera after the other."""

    def by_camera(entry: dict[str, Any]) -> bool:
        camera, time = entry["camera_id"], entry["timestep_index"]
        path = folder / "images" / camera / f"{time:05d}.png"
        path.parent.mkdir(exist_ok=True)
        shutil.copy(folder / entry["file_path"], path)
        entry["file_path"] = f"images/{camera}/{path.name}"
        return (camera, time) != ("07", 1)

    folder = tmp_path / "copy" / single.name
    edited(single, tmp_path / "copy", by_camera)
    subject, _ = opened(folder, tmp_path / "out", test_frames=1)
    for record in subject.manifest.frames:
        assert record.tracking == int(record.name[-5:])
    recording = subject.recording
    assert {recording.names[i] for i in recording.split.test} == {f"images_{name}_00005" for name in AZIMUTHS}


@pytest.mark.parametrize("cameras", ["12", "all"])
def test_times_of_validation_alone_are_neither_trained_on_nor_tested(
    cameras: str, single: Path, tmp_path: Path
) -> None:
    folder = edited(single, tmp_path / "copy", lambda _: None)
    files = [*folder.glob("transforms_*.json")]
    every = [entry for file in files for entry in json.loads(file.read_text())["frames"]]
    parts = {"train": (0, 1, 2), "val": (3,), "test": (4, 5)}
    write_listings(folder, {part: [e for e in every if e["timestep_index"] in own] for part, own in parts.items()})
    subject, said = opened(folder, tmp_path / "out", cameras=cameras)
    recording = subject.recording
    assert {recording.time(i) for i in recording.split.train} == {0, 1, 2}
    assert {recording.time(i) for i in recording.split.test} == {4, 5}
    assert any("(1 are not used)" in line for line in said)
