"""The image/tracking offset is found from masks and mesh, and never guessed."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tracked_folder import write_tracked_folder

from avatar.data.images import read_mask
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.frame_files import FrameFiles, find_frame_files
from data_prep.frame_offset import OffsetEstimate, detect_offset
from data_prep.metrical_tracker import FrameTrack, read_tracking

Paths = Mapping[int, Path]


@lru_cache(maxsize=1)
def read(folder: Path, head_path: Path) -> tuple[FrameFiles, dict[int, FrameTrack], HeadModel]:
    files = find_frame_files(folder)
    tracks = read_tracking(files.tracking).frames
    identity = torch.from_numpy(next(iter(tracks.values())).shape).float()
    return files, tracks, HeadModel(load_head_assets(head_path), identity)


def detect(folder: Path, head_path: Path, shift: int = 0, head: bool = True, mouth: bool = True) -> OffsetEstimate:
    """Detection on a folder whose images are renumbered by `shift`."""
    files, tracks, model = read(folder, head_path)
    first = next(iter(tracks.values()))

    def shifted(paths: Paths) -> Paths:
        return {number + shift: path for number, path in paths.items()}

    return detect_offset(
        model,
        tracks,
        first.intrinsics,
        shifted(files.images),
        shifted(files.head_masks) if head else {},
        shifted(files.mouth_masks) if mouth else {},
    )


@pytest.mark.parametrize("offset", [-1, 0, 1, 2, 40])
def test_synthetic_offsets(offset: int, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=16, offset=offset)
    estimate = detect(folder, folder / "head_model")
    assert estimate.offset == offset and estimate.t > 10
    assert estimate.head_overlap and estimate.mouth_overlap
    assert estimate.head_overlap > 0.99 and estimate.mouth_overlap > 0.95


@pytest.mark.parametrize("kinds", [{"mouth": False}, {"head": False}])
def test_one_kind_of_mask_is_enough(kinds: dict[str, bool], tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=24, offset=1)
    estimate = detect(folder, folder / "head_model", **kinds)
    assert estimate.offset == 1
    assert (estimate.head_overlap is None) == (not kinds.get("head", True))
    assert (estimate.mouth_overlap is None) == (not kinds.get("mouth", True))


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
    assert estimate.head_overlap is not None and estimate.head_overlap < 0.9


def test_a_random_pairing_is_not_taken_for_an_offset(tmp_path: Path) -> None:
    """Images and masks in another order belong to no offset; every seed must be refused."""
    for seed in range(5):
        folder = write_tracked_folder(tmp_path / str(seed), frames=30, seed=seed)
        order = np.random.default_rng(seed).permutation(30) + 1
        for pattern in ("imgs/{:05d}.jpg", "parsing/{:05d}_neckhead.png", "parsing/{:05d}_mouth.png"):
            data = {n: (folder / pattern.format(n)).read_bytes() for n in range(1, 31)}
            for number, other in enumerate(order, start=1):
                (folder / pattern.format(number)).write_bytes(data[int(other)])
        with pytest.raises(UserError, match="--frame-offset"):
            detect(folder, folder / "head_model")


@pytest.mark.shared
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
    assert estimate.head_overlap is not None and estimate.head_overlap > 0.8
    assert f"image offset {true_offset} (image number = tracking number {true_offset:+d})" in estimate.sentence()
