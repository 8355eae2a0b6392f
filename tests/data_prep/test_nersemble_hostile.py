"""Folders of NeRSemble's benchmark with something wrong: one sentence each."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nersemble_folder import ASIDE, SEQUENCES, TRAINED, edit_tracking, edit_video, opened, video, write_person

from avatar.errors import UserError

TWO = list(SEQUENCES)[:2]


@pytest.fixture(scope="module")
def person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_person(tmp_path_factory.mktemp("person"), sequences=TWO)


@pytest.fixture
def copy(person: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(person, tmp_path / "393"))


def edit_calibration(edit: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "calibration" / "camera_params.json"
        content = json.loads(path.read_text())
        edit(content)
        path.write_text(json.dumps(content))

    return change


def edit_values(edit: Callable[[dict[str, np.ndarray]], object]) -> Callable[[Path], None]:
    return lambda folder: edit_tracking(folder, edit, ["EXP-1-head"])


def repeat_serial(folder: Path) -> None:
    path = folder / "calibration" / "camera_params.json"
    path.write_text(path.read_text().replace('{"world_2_cam": {', f'{{"world_2_cam": {{"{ASIDE}": 1, '))


def make_black(folder: Path) -> None:
    for sequence in TWO:
        edit_video(video(folder, ASIDE, sequence), lambda pictures: [0 * one for one in pictures])


def cut_short(folder: Path) -> None:
    path = video(folder)
    path.write_bytes(path.read_bytes()[:-400])


def damage(folder: Path) -> None:
    data = bytearray(video(folder).read_bytes())
    start = data.index(b"mdat")
    data[start + 1200 : start + 2200] = bytes(1000)
    video(folder).write_bytes(data)


HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "a camera that is not calibrated": (
        edit_calibration(lambda raw: raw["world_2_cam"].pop(ASIDE)),
        f"camera_params.json has nothing on camera {ASIDE}",
    ),
    "a serial that is calibrated twice": (repeat_serial, f"camera_params.json: {ASIDE} is there twice"),
    "a video that was downloaded twice": (
        lambda f: shutil.copy(video(f), video(f).with_name(f"cam_{TRAINED} (1).mp4")),
        r"cam_222200037 \(1\).mp4 is not named cam_SERIAL.mp4",
    ),
    "a pose that is no rotation": (
        edit_calibration(lambda raw: raw["world_2_cam"][ASIDE][0].__setitem__(0, 7.0)),
        f"camera {ASIDE}: world_2_cam is not a rotation",
    ),
    "a lens of other pictures": (
        edit_calibration(lambda raw: raw["intrinsics"][ASIDE][0].__setitem__(2, 550.0)),
        f"the principal point of camera {ASIDE} is at 550, 30.5, but its videos have 72x64 pixels",
    ),
    "a negative focal length": (
        edit_calibration(lambda raw: raw["intrinsics"][ASIDE][0].__setitem__(0, -1.0)),
        "positive focal lengths",
    ),
    "a calibration without poses": (edit_calibration(lambda raw: raw.clear()), "lacks world_2_cam or intrinsics"),
    "a calibration that is no JSON": (
        lambda f: (f / "calibration/camera_params.json").write_bytes(b"[" * 100_000),
        "camera_params.json cannot be read as JSON",
    ),
    "a time without a picture": (
        lambda f: edit_video(video(f, ASIDE), lambda pictures: pictures[:-1]),
        "has 3 pictures, but .* has 4",
    ),
    "a matte of fewer pictures": (
        lambda f: edit_video(video(f, kind="alpha_maps"), lambda pictures: pictures[:-1]),
        "has 3 pictures, but .* has 4",
    ),
    "a missing matte": (lambda f: video(f, kind="alpha_maps").unlink(), "alpha_maps/cam_.*.mp4 is missing"),
    "two sizes": (
        lambda f: edit_video(video(f), lambda pictures: [one[:48, :48] for one in pictures]),
        "has .* pixels, but .* has .*; download them again",
    ),
    "a black camera": (make_black, f"the pictures of camera {ASIDE} are black"),
    "a video that is cut short": (cut_short, "tracks 4 pictures, the last with number 3, but the videos have [12]"),
    "a video with a damaged part": (damage, "cam_222200037.mp4 is damaged: picture . cannot be decoded"),
    "a video that is a list of files": (
        lambda f: video(f).write_text("ffconcat version 1.0\nfile /etc/passwd\n"),
        "is not an .mp4 video that can be read",
    ),
    "an empty video": (lambda f: video(f).write_bytes(b""), "is not an .mp4 video that can be read"),
    "a video that is a folder": (lambda f: (video(f).unlink(), video(f).mkdir()), "is a folder, not a file"),
    "tracking of other pictures": (
        edit_values(lambda values: values.update(frames=np.array([0, 1, 2, 3, 4, 9]))),
        "tracks 6 pictures, the last with number 9, but the videos have 6",
    ),
    "frames that go back": (
        edit_values(lambda values: values.update(frames=values["frames"][::-1])),
        "frames are not increasing whole numbers from 0 on",
    ),
    "tracking without a scale": (edit_values(lambda values: values.pop("scale")), "tracking_v2.npz lacks scale"),
    "a scale of zero": (edit_values(lambda values: values.update(scale=np.zeros((1, 1)))), "scale is 0, not above 0"),
    "two scales": (
        edit_values(lambda values: values.update(scale=values["scale"] * 1.1)),
        "so that their cameras do not",
    ),
    "rows that are missing": (
        edit_values(lambda values: values.update(jaw=values["jaw"][1:])),
        r"jaw has the shape \[5, 3\], not 3 values for each of 6 frames",
    ),
    "a turn that is not finite": (
        edit_values(lambda values: values["rotation_matrices"].__setitem__(slice(None), np.nan)),
        "rotation_matrices is not finite",
    ),
    "a recording without tracking": (
        lambda f: [shutil.rmtree(path) for path in f.glob("sequences/*/tracking")],
        "track a sequence first .*, or download the benchmark's mono_flame_avatar",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_folders_are_refused_in_a_sentence(name: str, copy: Path, tmp_path: Path) -> None:
    edit, sentence = HOSTILE[name]
    edit(copy)
    with pytest.raises(UserError, match=sentence) as error:
        opened(copy, tmp_path / "out")
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


def test_two_scales_agree_by_one_camera(copy: Path, tmp_path: Path) -> None:
    HOSTILE["two scales"][0](copy)
    subject, _ = opened(copy, tmp_path / "out", cameras=TRAINED)
    assert subject.recording.rig is None and len(subject.split.train) > 0


def test_a_head_beside_its_mattes_is_refused(copy: Path, tmp_path: Path) -> None:
    edit_tracking(copy, lambda values: values.update(translation=values["translation"] + np.float32([0.15, 0, 0])), TWO)
    with pytest.raises(UserError, match="does not lie on the masks"):
        opened(copy, tmp_path / "out")
