"""The demo person by many cameras: a folder of VHAP's export whose cameras and parameters are the truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from listed_views import CAMERAS, FRAMES, FRONT, NAMES, SEED, SIZE, listing

from avatar.cli import main
from avatar.demo import make_camera_folder, vhap_folder
from avatar.errors import UserError
from avatar.head.assets import HeadAssets

INTRINSICS = {"fl_x", "fl_y", "cx", "cy", "h", "w", "camera_angle_x", "camera_angle_y"}
PATHS = {"file_path", "fg_mask_path", "flame_param_path"}
ENTRY = (
    {"timestep_index", "timestep_index_original", "camera_index", "camera_id", "transform_matrix"} | INTRINSICS | PATHS
)
SHARED = {"frames", "timestep_indices", "camera_indices", "fps"} | INTRINSICS


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_sequence_has_the_files_of_an_export(camera_folder: Path) -> None:
    assert names(camera_folder) == ["FREE", "GAZE", "SPEECH", f"UNION_demo{SEED}", "head_model"]
    listings = [f"transforms{part}.json" for part in ("", "_test", "_train", "_val")]
    pictures = [f"{time:05d}_{camera:02d}.png" for time in range(FRAMES) for camera in range(CAMERAS)]
    for name in NAMES:
        own = camera_folder / name
        kinds = ["canonical_flame_param.npz", "fg_masks", "flame_param", "head_model", "images", *listings]
        assert names(own) == sorted(kinds)
        assert names(own / "images") == names(own / "fg_masks") == pictures
        assert names(own / "flame_param") == [f"{time:05d}.npz" for time in range(FRAMES)]
        image = cv2.imread(str(own / "images" / pictures[-1]), cv2.IMREAD_UNCHANGED)
        matte = cv2.imread(str(own / "fg_masks" / pictures[-1]), cv2.IMREAD_UNCHANGED)
        assert image is not None and matte is not None
        assert image.shape == (SIZE, SIZE, 3) and matte.shape == (SIZE, SIZE)
        assert matte.min() == 0 and matte.max() == 255


def test_an_entry_names_its_time_camera_and_files(camera_folder: Path) -> None:
    for name in NAMES:
        content = listing(camera_folder / name / "transforms.json")
        assert content.keys() == SHARED and content["fps"] == 25
        assert content["timestep_indices"] == [0, 1] and content["camera_indices"] == [0, 1, 2]
        assert len(content["frames"]) == FRAMES * CAMERAS
        for n, entry in enumerate(content["frames"]):
            time, camera = divmod(n, CAMERAS)
            assert entry.keys() == ENTRY | {"timestep_id"}
            assert entry["timestep_index"] == entry["timestep_index_original"] == time
            assert entry["camera_index"] == camera
            assert entry["file_path"] == f"images/{time:05d}_{camera:02d}.png"
            assert entry["fg_mask_path"] == f"fg_masks/{time:05d}_{camera:02d}.png"
            assert entry["flame_param_path"] == f"flame_param/{time:05d}.npz"
            assert (entry["w"], entry["h"]) == (SIZE, SIZE)
            assert np.tan(entry["camera_angle_x"] / 2) == pytest.approx(SIZE / 2 / entry["fl_x"])
            assert np.tan(entry["camera_angle_y"] / 2) == pytest.approx(SIZE / 2 / entry["fl_y"])
            matrix = np.array(entry["transform_matrix"])
            np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
            assert np.linalg.det(matrix[:3, :3]) > 0 and matrix[3].tolist() == [0, 0, 0, 1]


def test_a_parameter_file_holds_one_time(camera_folder: Path, assets: HeadAssets) -> None:
    shapes = {
        **dict.fromkeys(("translation", "rotation", "neck_pose", "jaw_pose"), (1, 3)),
        "eyes_pose": (1, 6),
        "expr": (1, 100),
        "shape": (300,),
        "static_offset": (1, assets.num_vertices, 3),
    }
    for file in [*camera_folder.glob("*/flame_param/*.npz"), *camera_folder.glob("*/canonical_flame_param.npz")]:
        with np.load(file) as held:
            values = dict(held)
        assert {key: value.shape for key, value in values.items()} == shapes
        assert all(value.dtype == np.float32 for value in values.values())
        assert not values["static_offset"].any() and not values["neck_pose"].any() and values["shape"].any()
    with np.load(camera_folder / "FREE" / "canonical_flame_param.npz") as rest:
        np.testing.assert_allclose(rest["jaw_pose"], [[0.3, 0, 0]], atol=1e-6)
        assert not any(rest[key].any() for key in ("translation", "rotation", "eyes_pose", "expr"))


def test_a_sequence_is_split_by_time_and_the_front_camera(camera_folder: Path) -> None:
    def held(split: str) -> list[tuple[int, int]]:
        entries = listing(camera_folder / "GAZE" / f"transforms_{split}.json")["frames"]
        return [(entry["timestep_index"], entry["camera_index"]) for entry in entries]

    assert held("train") == [(0, 0), (0, 2)] and held("val") == [(0, FRONT)]
    assert held("test") == [(1, 0), (1, 1), (1, 2)]


def test_the_union_lists_all_sequences_and_tests_the_last(camera_folder: Path) -> None:
    union = camera_folder / f"UNION_demo{SEED}"
    listings = [f"transforms_{split}.json" for split in ("test", "train", "val")]
    assert names(union) == ["head_model", "sequences_test.txt", "sequences_trainval.txt", *listings]
    assert (union / "sequences_trainval.txt").read_text().split() == ["SPEECH", "GAZE"]
    assert (union / "sequences_test.txt").read_text().split() == ["FREE"]
    times = {"train": [0, 1, 2, 3], "val": [0, 1, 2, 3], "test": [4, 5]}
    cameras = {"train": [0, 2], "val": [FRONT], "test": [0, 1, 2]}
    for split in times:
        content = listing(union / f"transforms_{split}.json")
        assert content["timestep_indices"] == times[split] and content["camera_indices"] == cameras[split]
        places = [(entry["timestep_index"], entry["camera_index"]) for entry in content["frames"]]
        assert places == [(time, camera) for time in times[split] for camera in cameras[split]]
        for entry in content["frames"]:
            sequence, time = divmod(entry["timestep_index"], FRAMES)
            assert entry.keys() == ENTRY and entry["timestep_index_original"] == time
            own = listing(camera_folder / NAMES[sequence] / "transforms.json")["frames"]
            original = own[time * CAMERAS + entry["camera_index"]]
            for key in PATHS:
                assert entry[key] == f"../{NAMES[sequence]}/{original[key]}" and (union / entry[key]).is_file()
            assert all(entry[key] == original[key] for key in ENTRY - PATHS - {"timestep_index"})


def test_every_folder_has_the_head_model(camera_folder: Path, assets: HeadAssets) -> None:
    written = {path.name: path.read_bytes() for path in (camera_folder / "head_model").iterdir()}
    for name in (*NAMES, f"UNION_demo{SEED}"):
        assert {path.name: path.read_bytes() for path in (camera_folder / name / "head_model").iterdir()} == written
    assert assets.eyelid_dirs is not None and assets.uvs is not None


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("new --cameras 1", "cameras must be from 2 to 64, not 1"),
        ("new --cameras 65", "cameras must be from 2 to 64, not 65"),
        ("new --cameras -3", "cameras must be from 2 to 64, not -3"),
        ("new --cameras 2 --frames 1", "with several cameras, frames must be from 2"),
        ("new --cameras 2 --size 32", "size must be from 64 to 1024, not 32"),
        ("new --cameras 2 --video", "leave out --video"),
        ("new.mp4 --cameras 2", "name a folder"),
        ("new.MOV --cameras 2", "name a folder"),
        ("new --cameras 2 --motion speech", "leave out --motion"),
        ("used --cameras 2", "used exists already and is not empty"),
    ],
)
def test_what_several_cameras_cannot_do_is_refused(
    options: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "notes.txt").write_text("mine")
    out, *others = options.split()
    assert main(["demo-data", str(tmp_path / out), *others]) == 1
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1
    assert names(tmp_path) == ["used"] and names(tmp_path / "used") == ["notes.txt"]


def test_the_command_says_what_to_train_on(printed: tuple[Path, str]) -> None:
    out, said = printed
    assert said == f"Next   avatar train {out / f'UNION_demo{SEED}'}\n"


def test_an_interrupted_run_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, *_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(vhap_folder, "write_image", full)
    with pytest.raises(UserError, match=r"No space left on device\); nothing was left"):
        make_camera_folder(tmp_path / "out", 2, 2, SIZE, SEED)
    assert not list(tmp_path.iterdir())


def test_all_cores_render(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[int] = []
    monkeypatch.setattr(vhap_folder, "in_order", lambda film, places, workers: used.append(workers) or [])
    monkeypatch.delenv("AVATAR_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        make_camera_folder(tmp_path / "out", 2, 2, SIZE, SEED)
    finally:
        torch.set_num_threads(before)
    assert used == [3]
