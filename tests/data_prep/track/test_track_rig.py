"""The demo's rig tracked from its pictures and calibration alone, against the truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rig_recording import serial_of, write_gha, write_raw
from small_runs import SMALL

from avatar.cli import main
from avatar.data.read_image import read_mask
from avatar.demo import vhap_folder
from avatar.errors import UserError
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.model import HeadModel
from data_prep.check.folder import check_tracked_folder
from data_prep.formats.detect import open_tracked_folder
from data_prep.prepare.projection import project_head
from data_prep.track.camera_rig.track_rig import track_rig

pytestmark = [pytest.mark.usefixtures("tracking_models"), pytest.mark.slow]
CAMERAS, TIMES, SIZE, UNIT = 5, 12, 256, 1.07
Seen = dict[tuple[str, int], np.ndarray]  # by camera and time: the head's vertices in pixels


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vhap_folder, "SEQUENCES", vhap_folder.SEQUENCES[:1])
        patch.setattr(vhap_folder, "_write_union", lambda folder, *_: folder.mkdir())
        out = tmp_path_factory.mktemp("truth") / "studio"
        vhap_folder.make_camera_folder(out, CAMERAS, TIMES, SIZE)
    return out / "SPEECH"


@pytest.fixture(scope="module")
def head(truth: Path) -> HeadAssets:
    return load_head_assets(truth / "head_model")


@pytest.fixture(scope="module")
def tracked(truth: Path, head: HeadAssets, tracking_models: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("raw")
    sequence = write_raw(truth, root, UNIT)
    said: list[str] = []
    track_rig([sequence], root / "out", truth / "head_model", head, say=said.append)
    (root / "said.txt").write_text("\n".join(said))
    return root / "out"


def projected(folder: Path, head: HeadAssets) -> Seen:
    opened = open_tracked_folder(folder)
    tracks = opened.read(head, (SIZE, SIZE), pytest.fail).frames
    model = HeadModel(head, torch.from_numpy(next(iter(tracks.values())).shape).float())
    above = model.neck()[1].numpy() > 0.5
    shots = {n: (serial_of(shot.camera), shot.time) for n, shot in opened.shots.items()}
    return {shots[n]: project_head(model, t, t.intrinsics, *t.size)[above, :2] for n, t in tracks.items()}


def test_the_head_lies_where_it_is_in_every_camera(truth: Path, tracked: Path, head: HeadAssets) -> None:
    true, found = projected(truth, head), projected(tracked, head)
    assert found.keys() == true.keys() and len(found) == CAMERAS * TIMES
    for camera in {camera for camera, _ in true}:
        errors = [np.linalg.norm(true[key] - found[key], axis=1).mean() for key in true if key[0] == camera]
        assert np.mean(errors) < 0.012 * SIZE, camera
    said = (tracked.parent / "said.txt").read_text()
    assert "5 cameras; the front one is 222200002" in said and "median error falls from" in said
    assert "frames in front\n" in said and ".partial" not in said
    assert said.count("note: colours are corrected by ") == 1


def test_pictures_mattes_and_lenses(truth: Path, tracked: Path) -> None:
    listed = {
        (f["camera_id"], f["timestep_index"]): f
        for f in json.loads((tracked / "transforms.json").read_text())["frames"]
    }
    for entry in json.loads((truth / "transforms.json").read_text())["frames"][::7]:
        own = listed[serial_of(entry["camera_id"]), entry["timestep_index"]]
        assert all(own[key] == pytest.approx(entry[key]) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"))
        wanted, given = (cv2.imread(str(f / e["file_path"])) for f, e in ((truth, entry), (tracked, own)))
        assert cv2.PSNR(wanted, given) > 30
        a, b = (read_mask(f / e["fg_mask_path"]) > 127 for f, e in ((truth, entry), (tracked, own)))
        assert (a & b).sum() / (a | b).sum() > 0.95


def test_check_and_training_take_it(truth: Path, tracked: Path, head: HeadAssets, tmp_path: Path) -> None:
    outcome = check_tracked_folder(tracked, lambda: head)
    assert [finding.problem for finding in outcome.findings if finding.severity == "error"] == []
    options = [*SMALL, "data.size=32", "trainer.perceptual=none", "trainer.iterations=4"]
    given = ["--head", str(truth / "head_model"), "--out", str(tmp_path / "run")]
    assert main(["train", str(tracked), *given, *options]) == 0


def test_a_folder_of_gaussian_head_avatar(truth: Path, head: HeadAssets, tmp_path: Path) -> None:
    """Its front camera is found by the landmarks, its masks are used, and its pictures are made smaller."""
    said: list[str] = []
    folder = write_gha(truth, tmp_path / "gha", 1.0)
    track_rig([folder], tmp_path / "out", truth / "head_model", head, size=128, say=said.append)
    assert "5 cameras; the front one is 222200002" in said[0]
    true, found = projected(truth, head), projected(tmp_path / "out", head)
    assert np.mean([np.linalg.norm(true[key] / 2 - found[key], axis=1).mean() for key in true]) < 0.012 * 128


def test_pictures_without_a_face_are_refused(truth: Path, head: HeadAssets, tmp_path: Path) -> None:
    folder = write_gha(truth, tmp_path / "gha", 1.0)
    for path in folder.rglob("image_*.jpg"):
        cv2.imwrite(str(path), np.full((SIZE, SIZE, 3), 90, np.uint8))
    with pytest.raises(UserError, match="no face was found in the first 3 pictures of any camera"):
        track_rig([folder], tmp_path / "out", truth / "head_model", head)
    assert not [path for path in tmp_path.iterdir() if path.name != "gha"]


def test_a_calibration_of_another_recording_is_refused(truth: Path, head: HeadAssets, tmp_path: Path) -> None:
    folder = write_gha(truth, tmp_path / "gha", 1.0)
    for cameras in (folder / "cameras").iterdir():
        places = sorted(cameras.iterdir())
        kept = [path.read_bytes() for path in places]
        for path, data in zip(places, (*kept[1:], kept[0]), strict=True):
            path.write_bytes(data)
    with pytest.raises(UserError, match="calibration .* does not fit the pictures"):
        track_rig([folder], tmp_path / "out", truth / "head_model", head)
    shutil.rmtree(tmp_path / ".out.partial", ignore_errors=True)


def test_two_sequences_get_one_identity_and_their_own_places(truth: Path, head: HeadAssets, tmp_path: Path) -> None:
    """FREE, here the beginning of SPEECH once more, is listed for testing."""
    sequence = write_raw(truth, tmp_path, UNIT)
    free = write_raw(truth, tmp_path / "again", UNIT, times=8).rename(sequence.parent / "FREE")
    track_rig([sequence, free], tmp_path / "out", truth / "head_model", head, size=SIZE, say=lambda _: None)
    true, found = projected(truth, head), projected(tmp_path / "out", head)
    errors = {
        (camera, time): np.linalg.norm(true[camera, time % (TIMES + 1)] - points, axis=1).mean()
        for (camera, time), points in found.items()
    }
    assert len(errors) == CAMERAS * (TIMES + 8) and np.mean([*errors.values()]) < 0.012 * SIZE
    opened = open_tracked_folder(tmp_path / "out")
    tested = {opened.shots[n].time for n, part in opened.division.items() if part == "test"}
    assert tested == {*range(TIMES + 1, TIMES + 9)}  # between the two a time is missing
