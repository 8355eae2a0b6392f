"""Cameras in listings of NeRF's manner."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar.errors import UserError
from data_prep.formats.frame_track import BadFrame
from data_prep.formats.root_pose import rotation_matrix
from data_prep.formats.transforms import ListedFrame, camera_pose, numbered, pinhole, read_listings


def test_validation_is_held_out_where_no_test_is(tmp_path: Path) -> None:
    def divided(*splits: str) -> dict[str, str | None]:
        for old in tmp_path.iterdir():
            old.unlink()
        for split in splits:
            frames = {"frames": [{"file_path": f"{split}.png"}]}
            (tmp_path / f"transforms_{split}.json").write_text(json.dumps(frames))
        return {frame.values["file_path"]: frame.split for frame in read_listings(tmp_path)}

    assert divided("train", "val") == {"train.png": "train", "val.png": "test"}
    assert divided("train", "val", "test") == {"train.png": "train", "val.png": "val", "test.png": "test"}


def listed(**values: Any) -> ListedFrame:
    return ListedFrame(Path("transforms.json"), 0, values, {}, None, Path())


@pytest.mark.parametrize(
    ("paths", "numbers"),
    [
        ("a/1 a/2 b/1 b/2", (0, 1, 3, 4)),
        ("a/1 a/2 a/3 a/9 a/10", (0, 1, 2, 4, 5)),
        ("a/0_3 a/2_3 a/4_3 a/8_3 a/10_3 b/9_3", (0, 1, 2, 4, 5, 7)),  # every other frame, of camera 3
        ("a/1_1 a/1_2 a/9_1 a/9_2", (0, 1, 2, 3)),  # of two cameras: their times are separated elsewhere
        ("a/x a/y9 b/c", (0, 1, 3)),
        (f"a/{10**40} a/{10**40 + 1} a/{10**40 + 9}", (0, 1, 3)),
    ],
)
def test_numbered_frames_lack_a_number_between_two_folders_and_where_names_skip(
    paths: str, numbers: tuple[int, ...]
) -> None:
    frames = [listed(file_path=f"{path}.png") for path in paths.split()]
    assert [*numbered(frames)] == [*numbers] and [*numbered(frames).values()] == frames


@pytest.mark.parametrize("folder", ["person", "UNION_person"])
@pytest.mark.parametrize("name", [".", "./", "./.", ".\\", "/"])
def test_a_path_that_is_the_folder_itself_is_refused(name: str, folder: str, tmp_path: Path) -> None:
    (tmp_path / folder).mkdir()
    frame = {"file_path": "images/1.png", "flame_param_path": name}
    (tmp_path / folder / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    (read,) = read_listings(tmp_path / folder)
    with pytest.raises(UserError, match=r"transforms.json: flame_param_path of frame 0 is '.*', which"):
        read.path("flame_param_path")
    (tmp_path / folder / "transforms.json").write_text(json.dumps({"frames": [{"file_path": name}]}))
    with pytest.raises(UserError, match=r"transforms.json: file_path of frame 0 is '.*', which"):
        read_listings(tmp_path / folder)


def test_a_camera_in_the_world_becomes_the_way_from_the_world_to_it() -> None:
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3], T_world_cam[:3, 3] = rotation_matrix(np.array([0.3, -0.5, 0.2])), (0.1, -0.2, 0.7)
    R, t = camera_pose(listed(transform_matrix=T_world_cam.tolist()))
    np.testing.assert_allclose(R @ T_world_cam[:3, 3] + t, 0.0, atol=1e-12)  # the camera is at its own origin
    ahead = T_world_cam @ (0.0, 0.0, -1.0, 1.0)
    np.testing.assert_allclose(R @ ahead[:3] + t, (0.0, 0.0, -1.0), atol=1e-12)


def test_a_lens_by_its_angles() -> None:
    intrinsics, size = pinhole(listed(camera_angle_x=np.pi / 2), (64, 48))
    assert size == (64, 48) and intrinsics.tolist() == pytest.approx([32.0, 32.0, 32.0, 24.0])
    angles = {"camera_angle_x": 2 * np.arctan(0.5 * 64 / 50), "camera_angle_y": 2 * np.arctan(0.5 * 48 / 60)}
    intrinsics, _ = pinhole(listed(**angles), (64, 48))
    assert intrinsics.tolist() == pytest.approx([50.0, 60.0, 32.0, 24.0])
    with pytest.raises(BadFrame, match="camera_angle_y is 4, not between 0 and pi"):
        pinhole(listed(**{**angles, "camera_angle_y": 4.0}), (64, 48))
    intrinsics, size = pinhole(listed(fl_x=50.0, fl_y=60.0, cx=10.0, cy=20.0, w=128, h=96), (64, 48))
    assert size == (128, 96) and intrinsics.tolist() == [50.0, 60.0, 10.0, 20.0]


@pytest.mark.parametrize(("fl_x", "fl_y"), [(0.0, 50.0), (50.0, 0.0), (-1.0, None)])
def test_both_focal_lengths_have_to_be_positive(fl_x: float, fl_y: float | None) -> None:
    with pytest.raises(BadFrame, match="the focal lengths fl_x and fl_y are not positive"):
        pinhole(listed(fl_x=fl_x, fl_y=fl_y), (64, 48))


@pytest.mark.parametrize(("side", "is_size"), [(0.9, False), (1, True), (65535, True), (65536, False)])
def test_sides_of_pictures_are_from_1_to_65535(side: float, is_size: bool) -> None:
    for w, h in ((side, 48), (64, side)):
        frame = listed(fl_x=50.0, w=w, h=h)
        if is_size:
            assert pinhole(frame, (64, 48))[1] == (w, h)
        else:
            with pytest.raises(BadFrame, match="w and h are .*, which no image is"):
                pinhole(frame, (64, 48))
