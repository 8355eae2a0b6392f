"""Folders as GaussianBlendshapes hands them out: the pairing by number, the mattes, and what is tested."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from blendshapes_folder import CENTRE, FOCAL, renumber, write_blendshapes
from preparing import prepare_folder

from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.check.folder import check_tracked_folder
from data_prep.formats import blendshapes


@pytest.fixture(scope="module", params=["INSTA", "NeRFBlendShape"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_blendshapes(tmp_path_factory.mktemp(request.param) / "x", image_mask=request.param != "INSTA")


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def test_images_and_tracking_of_one_number_are_one_frame(folder: Path, tmp_path: Path) -> None:
    subject, said = prepare_folder(folder, tmp_path / "out")
    assert said[0] == "format: GaussianBlendshapes"
    assert "paired by the number in their names" in said[1]
    recording = subject.recording
    np.testing.assert_allclose(recording.intrinsics, (FOCAL, FOCAL, *CENTRE), atol=1e-4)
    assert [(frame.name, frame.tracking) for frame in subject.manifest.frames] == [(f"{n:05d}", n) for n in range(24)]
    head = HeadModel(load_head_assets(folder / "head_model"), subject.identity)
    for index in range(0, len(subject), 5):
        frame = subject.frame(index)
        screen = frame.camera.project(head.vertices(frame.params))[:, :2].numpy()
        rows, columns = np.nonzero(frame.alpha.numpy() > 0.5)  # the matte, of which the mesh covers the same
        assert 100 < len(rows) < 3000
        np.testing.assert_allclose(screen.min(axis=0), (columns.min(), rows.min()), atol=1.6)
        np.testing.assert_allclose(screen.max(axis=0), (columns.max() + 1, rows.max() + 1), atol=1.6)


def test_a_short_clip_is_divided_as_any_other(folder: Path, tmp_path: Path) -> None:
    subject, _ = prepare_folder(folder, tmp_path / "out")
    assert subject.split == (tuple(range(19)), tuple(range(19, 24)))


@pytest.mark.parametrize(("tested", "train"), [(9, 15), (12, 12), (13, 19)])
def test_the_last_frames_are_tested_where_as_many_are_left_to_train_on(
    tested: int, train: int, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """INSTA's papers test 350, NeRFBlendShape's 500."""
    assert (blendshapes.INSTA_TESTED, blendshapes.NERFBLENDSHAPE_TESTED) == (350, 500)
    has_mattes = (folder / "image_mask").exists()
    monkeypatch.setattr(blendshapes, "NERFBLENDSHAPE_TESTED" if has_mattes else "INSTA_TESTED", tested)
    subject, said = prepare_folder(folder, tmp_path / "out")
    assert subject.split == (tuple(range(train)), tuple(range(train, 24)))
    assert any("own division" in line for line in said) == (train != 19)
    assert any("too many of 24" in line for line in said) == (train == 19)
    asked, _ = prepare_folder(folder, tmp_path / "asked", test_frames=4)
    assert asked.split.test == (20, 21, 22, 23)


def test_an_offset_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--frame-offset 1: .*leave it out"):
        prepare_folder(folder, tmp_path / "out", frame_offset=1)


@pytest.mark.parametrize("kind", ["images", "checkpoint"])
@pytest.mark.parametrize("lost", [0, 2])
def test_shifted_numbers_are_refused(lost: int, kind: str, copy: Path, tmp_path: Path) -> None:
    """Paired by number they would be one frame apart, whether both have equally many or the other lost its last ones."""
    renumber(copy, kind, 1)
    other = copy / ("checkpoint" if kind == "images" else "images")
    for path in sorted(other.iterdir())[24 - lost :]:
        path.unlink()
    with pytest.raises(UserError, match="images/ has the numbers .* and checkpoint/ .*imgs/"):
        prepare_folder(copy, tmp_path / "out")


def test_a_missing_picture_is_left_out(copy: Path, tmp_path: Path) -> None:
    (copy / "images" / "00007.png").unlink()
    subject, said = prepare_folder(copy, tmp_path / "out")
    assert len(subject) == 23 and "00007" not in subject.recording.names
    assert "note: images skips the numbers 00007" in said


@pytest.mark.parametrize("by", [1, 100])
def test_masks_of_other_numbers_are_refused(by: int, tmp_path: Path) -> None:
    folder = write_blendshapes(tmp_path / "x", image_mask=True)
    renumber(folder, "image_mask", by)
    with pytest.raises(UserError, match=rf"image_mask has the numbers {by:05d} to .* and images 00000 to 00023, but"):
        prepare_folder(folder, tmp_path / "out")


def test_files_decide_the_format(copy: Path, tmp_path: Path) -> None:
    """With imgs/ beside images/ it may be a folder of metrical-tracker, whose offset is sought."""
    (copy / "imgs").mkdir()
    for path in (copy / "images").iterdir():
        picture = cv2.imread(str(path))
        assert picture is not None and cv2.imwrite(str(copy / "imgs" / path.name), picture)
    with pytest.raises(UserError, match="metrical-tracker or GaussianBlendshapes; say which with --data-format"):
        prepare_folder(copy, tmp_path / "out")
    _, said = prepare_folder(copy, tmp_path / "out", data_format="metrical-tracker")
    assert said[0] == "format: metrical-tracker"
    _, said = prepare_folder(copy, tmp_path / "out2", data_format="GaussianBlendshapes")
    assert said[0] == "format: GaussianBlendshapes"
    shutil.rmtree(copy / "checkpoint")
    with pytest.raises(UserError, match="not a folder of GaussianBlendshapes's"):
        prepare_folder(copy, tmp_path / "out3", data_format="GaussianBlendshapes")


def test_check_finds_nothing_wrong(folder: Path) -> None:
    outcome = check_tracked_folder(folder, lambda: load_head_assets(folder / "head_model"))
    assert not [finding for finding in outcome.findings if finding.severity == "error"]
    assert "paired by the number in their names" in outcome.to_dict()["facts"]["offset found"]
