"""The image/tracking offset is found from masks and mesh, and never guessed."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from preparing import prepare_folder
from tracked_folder import write_tracked_folder

from avatar.data.read_image import read_mask
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.formats.frame_files import FrameFiles, find_frame_files
from data_prep.formats.metrical_tracker import FrameTrack, read_tracking
from data_prep.prepare import frame_offset
from data_prep.prepare.frame_offset import OffsetEstimate, detect_offset

pytestmark = pytest.mark.slow


@lru_cache(maxsize=1)
def read(folder: Path, head_path: Path) -> tuple[FrameFiles, dict[int, FrameTrack], HeadModel]:
    files = find_frame_files(folder)
    tracks = read_tracking(files.tracking).frames
    identity = torch.from_numpy(next(iter(tracks.values())).shape).float()
    return files, tracks, HeadModel(load_head_assets(head_path), identity)


def detect(folder: Path, head_path: Path, shift: int = 0, head: bool = True, mouth: bool = True) -> OffsetEstimate:
    """Detection on a folder whose images are renumbered by `shift`, without the masks that are not wanted."""
    files, tracks, model = read(folder, head_path)
    wanted = {"images": True, "alphas": head, "head_masks": head, "mouth_masks": mouth}
    shifted = {
        kind: {number + shift: path for number, path in getattr(files, kind).items()} if is_wanted else {}
        for kind, is_wanted in wanted.items()
    }
    return detect_offset(model, tracks, replace(files, **shifted))


@pytest.mark.parametrize("offset", [-1, 0, 1, 2, 40])
def test_synthetic_offsets(offset: int, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=16, offset=offset)
    estimate = detect(folder, folder / "head_model")
    assert estimate.offset == offset and estimate.t > 10 and not estimate.used_images


@pytest.mark.parametrize("following", [0, 4])
def test_what_masks_say_is_named_where_few_frames_follow_each_other(
    following: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their motion, which would have to decide, is not known."""
    folder = write_tracked_folder(tmp_path / "subject", frames=32, offset=1)
    for path in sorted((folder / "checkpoint").iterdir())[following::2]:
        path.unlink()
    monkeypatch.setattr(frame_offset, "MIN_T", 1e3)
    with pytest.raises(UserError, match=r"image number = tracking number \+1\), better than offset -?[0-9]+ by [1-9]"):
        detect(folder, folder / "head_model")


@pytest.mark.parametrize("kinds", [{"mouth": False}, {"head": False}])
def test_one_kind_of_mask_is_enough(kinds: dict[str, bool], tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=24, offset=1)
    estimate = detect(folder, folder / "head_model", **kinds)
    assert estimate.offset == 1


@pytest.mark.parametrize("offset", [0, 1])
def test_hair_and_sloppy_masks(offset: int, tmp_path: Path) -> None:
    """Masks that are always larger than the mesh, and whose outline trembles by a pixel."""
    folder = write_tracked_folder(tmp_path / "subject", frames=60, size=96, offset=offset)
    rng = np.random.default_rng(0)
    for path in (folder / "parsing").iterdir():
        mask = read_mask(path)
        mask = np.roll(mask, rng.integers(-1, 2, 2), (0, 1))
        if "neckhead" in path.name:
            mask = np.maximum(cv2.dilate(mask, np.ones((5, 5))), np.roll(mask, -12, 0))
        else:
            mask = cv2.dilate(mask, np.ones((3, 3)))
        cv2.imwrite(str(path), mask)
    estimate = detect(folder, folder / "head_model")
    assert estimate.offset == offset


def test_a_random_pairing_is_not_taken_for_an_offset(tmp_path: Path) -> None:
    """Images and masks in another order belong to no offset; every seed must be refused."""
    for seed in range(5):
        folder = write_tracked_folder(tmp_path / str(seed), frames=30, seed=seed)
        order = np.random.default_rng(seed).permutation(30) + 1
        for pattern in ("imgs/{:05d}.jpg", "parsing/{:05d}_neckhead.png", "parsing/{:05d}_mouth.png"):
            data = {n: (folder / pattern.format(n)).read_bytes() for n in range(1, 31)}
            for number, other in enumerate(order, start=1):
                (folder / pattern.format(number)).write_bytes(data[int(other)])
        with pytest.raises(UserError, match="lie on the|give --frame-offset"):
            detect(folder, folder / "head_model")


@pytest.mark.parametrize(
    ("lost", "sentence"),
    [(41, "1 fits all in all, but 0 from frame .*"), (20, "0 fits all in all, but 1 up to frame .*")],
)
def test_a_picture_that_is_lost_within_the_clip_is_noticed(lost: int, sentence: str, tmp_path: Path) -> None:
    """All pictures after it have a number less, as an extraction numbers them that drops one."""
    folder = write_tracked_folder(tmp_path / "subject", frames=60)
    files, tracks, model = read(folder, folder / "head_model")
    kinds = {
        kind: {number - (number > lost): path for number, path in getattr(files, kind).items() if number != lost}
        for kind in ("images", "alphas", "head_masks", "mouth_masks")
    }
    with pytest.raises(UserError, match=f"changes within the clip: {sentence}; one of them lacks frames"):
        detect_offset(model, tracks, replace(files, **kinds))


@pytest.mark.parametrize("frames", [1, 6])
def test_too_few_frames_are_called_that(frames: int, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=frames)
    sentence = f"there are too few frames to find the offset between images and tracking ({frames} images, {frames}"
    with pytest.raises(UserError, match=re.escape(sentence)) as error:
        detect(folder, folder / "head_model")
    assert str(error.value).endswith("; give --frame-offset (1 where images are numbered from 1 and tracking from 0)")


@pytest.mark.shared
def test_a_given_offset_that_the_frames_contradict_is_said(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=16, offset=1)
    subject, said = prepare_folder(folder, tmp_path / "out", frame_offset=2, ignore_misfit=True)
    warning = "--frame-offset 2 is used, but the frames fit image offset 1 (image number = tracking number +1), better"
    assert subject.manifest.frame_offset == 2 and [line for line in said if warning in line]
    _, said = prepare_folder(folder, tmp_path / "right", frame_offset=1)
    assert not [line for line in said if "--frame-offset 1 is used" in line]


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [{"mouth": False}, {"mouth": False, "head": False}])
def test_the_images_decide_where_masks_cannot(kinds: dict[str, bool], shared_dir: Path) -> None:
    """Head masks alone hardly move with speech; the lips in the images do."""
    subjects = shared_dir / "subjects"
    estimate = detect(subjects / "carla", subjects / "head_model", shift=1, **kinds)
    assert estimate.offset == 2 and estimate.used_images and estimate.t > 4
    assert "from the motion in the images" in estimate.sentence()


@pytest.mark.shared
@pytest.mark.parametrize(("name", "true_offset"), [("anna", -1), ("anna", 0), ("anna", 2), ("carla", 1)])
def test_development_subjects(name: str, true_offset: int, shared_dir: Path) -> None:
    subjects = shared_dir / "subjects"
    estimate = detect(subjects / name, subjects / "head_model", shift=true_offset - 1)
    assert estimate.offset == true_offset and estimate.t > 5
    assert f"image offset {true_offset} (image number = tracking number {true_offset:+d})" in estimate.sentence()
