"""Recordings by several cameras: what is read of the two layouts, and one sentence for each thing that is wrong."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rig_recording import FILMED, write_plain_raw
from videos import encode

from avatar.cli import main
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.track.camera_rig import gha_folder, recording, track_rig
from data_prep.track.camera_rig.camera_pictures import Times
from data_prep.track.camera_rig.recording import Recording
from data_prep.track.footage.picture_folder import PictureFolder
from data_prep.track.footage.source import Span, stride, whole

SERIALS = list(FILMED)


def same(opened: Recording) -> None:
    """The cameras of FILMED, and their four pictures."""
    assert list(opened.cameras) == SERIALS
    for serial, camera in opened.cameras.items():
        wanted = FILMED[serial]
        assert np.allclose(camera.R, wanted.pose[:3, :3], atol=1e-6) and np.allclose(camera.t, wanted.pose[:3, 3])
        assert np.allclose(camera.intrinsics, [wanted.K[0, 0], wanted.K[1, 1], wanted.K[0, 2], wanted.K[1, 2]])
        footage = camera.footage
        grey = [p.image.mean() for p in footage.read(whole(footage.width, footage.height), Span(), lambda _: None)]
        assert np.abs(np.array(grey) - wanted.greys).max() < 3


def test_nersemble(raw: Path, tmp_path: Path) -> None:
    assert track_rig.recognise(raw) and not track_rig.recognise(raw.parent)
    same(recording.open_recording(raw))
    assert recording.open_recording(raw).front == "222200037"


def test_colours_of_large_videos_without_a_tag_are_those_of_the_pictures(raw: Path, tmp_path: Path) -> None:
    folder = changed(raw, tmp_path, lambda _: None)
    for path in folder.rglob("cam_*.mp4"):
        encode(path, [np.full((720, 720, 3), (180, 60, 40), np.uint8)] * 2)
    for camera in recording.open_recording(folder).cameras.values():
        picture = next(camera.footage.read(whole(720, 720), Span(), lambda _: None))
        assert np.abs(picture.image.astype(int) - (180, 60, 40)).max() <= 3


def test_nersemble_with_one_lens_for_all(raw: Path, tmp_path: Path) -> None:
    K = FILMED[SERIALS[0]].K.tolist()
    folder = changed(raw, tmp_path, lambda content: content.update(intrinsics=K))
    assert {camera.intrinsics[0] for camera in recording.open_recording(folder).cameras.values()} == {K[0][0]}


def test_gaussian_head_avatar(gha: Path) -> None:
    assert track_rig.recognise(gha)
    opened = gha_folder.open_recording(gha)
    same(opened)
    mattes = opened.cameras[SERIALS[0]].mattes
    assert opened.front is None and mattes is not None
    first = next(mattes.read(whole(mattes.width, mattes.height), Span(), lambda _: None))
    assert first.image.min() > 250


def test_gaussian_head_avatar_without_masks(gha: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(gha, tmp_path / "someone"))
    for mask in folder.rglob("mask_*.jpg"):
        mask.unlink()
    assert {camera.mattes for camera in gha_folder.open_recording(folder).cameras.values()} == {None}


def test_cameras_without_pictures_are_left_out(raw: Path, gha: Path, tmp_path: Path) -> None:
    folder, images = changed(raw, tmp_path, lambda _: None), Path(shutil.copytree(gha, tmp_path / "someone"))
    for path in (*folder.rglob(f"cam_{SERIALS[0]}.mp4"), *images.rglob(f"*_{SERIALS[0]}.jpg")):
        path.unlink()
    for opened in (recording.open_recording(folder), gha_folder.open_recording(images)):
        assert list(opened.cameras) == SERIALS[1:] and opened.unused == (SERIALS[0],)


def test_a_picture_less_is_let_pass(gha: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(gha, tmp_path / "someone"))
    (folder / "images" / "0001" / f"image_{SERIALS[0]}.jpg").unlink()
    cameras = gha_folder.open_recording(folder).cameras.values()
    assert {camera.footage.duration for camera in cameras} == {3 / 25}


def changed(raw: Path, root: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    """A copy with another calibration."""
    shutil.copytree(raw.parent.parent, root / "person")
    path = root / "person" / "calibration" / "camera_params.json"
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))
    return root / "person" / "sequences" / raw.name


def without_calibration(folder: Path) -> None:
    shutil.rmtree(folder.parent.parent / "calibration")


def shorter(folder: Path) -> None:
    write_plain_raw(folder.parent / "short", frames=1)
    short = next((folder.parent / "short").rglob(f"cam_{SERIALS[1]}.mp4"))
    shutil.copy(short, folder / "images")


def damaged(folder: Path) -> None:
    path = folder / "images" / f"cam_{SERIALS[1]}.mp4"
    path.write_bytes(path.read_bytes()[:-300])


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            without_calibration,
            "has videos of 3 cameras, but there is no .*camera_params.json; give ID/sequences/SEQUENCE",
        ),
        (shorter, f"cam_{SERIALS[1]}.mp4 has 1 pictures, but .*.mp4 has 4"),
        (damaged, f"cam_{SERIALS[1]}.mp4 is cut short"),
    ],
)
def test_folders_of_nersemble_that_are_refused(
    raw: Path, tmp_path: Path, spoil: Callable[[Path], None], said: str
) -> None:
    folder = changed(raw, tmp_path, lambda _: None)
    spoil(folder)
    with pytest.raises(UserError, match=said):
        recording.open_recording(folder)


def drop(content: dict[str, Any]) -> None:
    del content["world_2_cam"][SERIALS[2]]


def mirror(content: dict[str, Any]) -> None:
    content["world_2_cam"][SERIALS[1]][0] = [-x for x in content["world_2_cam"][SERIALS[1]][0]]


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (drop, f"camera {SERIALS[2]} has pictures, but nothing in .*camera_params.json"),
        (mirror, f"camera {SERIALS[1]}: world_2_cam is not a rotation"),
        (lambda content: content["intrinsics"].pop(SERIALS[0]), f"has nothing on camera {SERIALS[0]}"),
        (lambda content: content.clear(), "lacks world_2_cam or intrinsics"),
    ],
)
def test_calibrations_that_are_refused(
    raw: Path, tmp_path: Path, edit: Callable[[dict[str, Any]], object], said: str
) -> None:
    with pytest.raises(UserError, match=said):
        recording.open_recording(changed(raw, tmp_path, edit))


def write_camera(folder: Path, time: str = "0000", **arrays: np.ndarray) -> None:
    wanted = FILMED[SERIALS[0]]
    values: dict[str, Any] = {"extrinsic": wanted.pose[:3], "intrinsic": wanted.K} | arrays
    np.savez(folder / "cameras" / time / f"camera_{SERIALS[0]}.npz", **values)


def thin_out(folder: Path) -> None:
    for time in ("0000", "0001", "0002"):
        (folder / "images" / time / f"image_{SERIALS[0]}.jpg").unlink()


def twin(folder: Path, serial: str) -> None:
    for path in folder.rglob(f"*_{SERIALS[0]}.*"):
        shutil.copy(path, path.with_stem(path.stem.replace(SERIALS[0], serial)))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda folder: (folder / "images" / "0001" / f"mask_{SERIALS[0]}.jpg").unlink(),
            f"0001/mask_{SERIALS[0]}.jpg is missing, while other pictures have masks",
        ),
        (lambda folder: twin(folder, f"0{SERIALS[0]}"), f"of 0{SERIALS[0]} and of {SERIALS[0]}, which are one number"),
        (lambda folder: twin(folder, "left"), "image_left.jpg: a camera's serial is a number"),
        (
            lambda folder: shutil.copytree(folder / "images" / "0001", folder / "images" / "1"),
            "of 0001 and of 1, which are one number",
        ),
        (lambda folder: shutil.rmtree(folder / "cameras"), "has pictures of several cameras, but no cameras/0000/"),
        (
            lambda folder: (folder / "cameras" / "0000" / f"camera_{SERIALS[0]}.npz").unlink(),
            f"camera {SERIALS[0]} has pictures, but nothing in .*cameras/0000",
        ),
        (thin_out, f"image_{SERIALS[0]}.jpg has 1 pictures, but .* has 4"),
        (lambda folder: write_camera(folder, extrinsic=np.eye(3)), "npz: extrinsic has 9 values, not 12"),
        (lambda folder: write_camera(folder, intrinsic=-np.eye(3)), "npz: intrinsic is not of the form"),
        (lambda folder: write_camera(folder, "0003", extrinsic=np.eye(4)[:3]), "moves between"),
        (
            lambda folder: (folder / "images" / "0002" / f"image_{SERIALS[0]}.jpg").write_bytes(b"no picture"),
            "is neither a JPEG nor a PNG",
        ),
        (
            lambda folder: cv2.imwrite(
                str(folder / "images" / "0000" / f"mask_{SERIALS[0]}.jpg"), np.zeros((32, 48), np.uint8)
            ),
            f"0000/mask_{SERIALS[0]}.jpg is 48x32 pixels but image_{SERIALS[0]}.jpg is 64x64; make the masks",
        ),
    ],
)
def test_folders_of_gaussian_head_avatar_that_are_refused(
    gha: Path, tmp_path: Path, spoil: Callable[[Path], object], said: str
) -> None:
    folder = Path(shutil.copytree(gha, tmp_path / "someone"))
    spoil(folder)
    with pytest.raises(UserError, match=said):
        for camera in gha_folder.open_recording(folder).cameras.values():
            list(camera.footage.read(whole(64, 64), Span(), lambda _: None))


@pytest.mark.parametrize(
    ("rate", "late", "wanted"), [(60.0, 1.0, [1, 3, 7]), (60.0, 0.8, [1, 3, 7]), (96.0, 1.2, [1, 4, 10])]
)
def test_a_camera_that_begins_at_another_time_loses_no_picture(rate: float, late: float, wanted: list[int]) -> None:
    """The nearest pictures are taken of all, though the front camera's tracking took every second or third."""
    fps, files = rate / stride(rate), tuple(Path(str(n)) for n in range(12))
    footage = PictureFolder(
        Path("side"), 64, 64, rate, 1.0, None, (), files, lambda path: (np.full((64, 64, 3), int(path.name)), False)
    )
    picked = Times([0, 1, 3], late / rate, fps).pick(footage, whole(64, 64))
    assert [(number, image[0, 0, 0]) for number, image in picked] == [*zip([0, 1, 3], wanted, strict=True)]


def test_the_command_refuses_what_is_for_one_camera(
    raw: Path, tmp_path: Path, demo_head_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["track", str(raw), "--out", str(tmp_path / "out"), "--head", str(demo_head_model)]
    for more, said in (
        (["--focal", "900"], "leave out --focal"),
        (["--crop", "none"], "leave out --focal"),
        (["--size", "8"], "--size must be from 64 to 4096"),
        (["--start", "2", "--end", "1"], "--end must be a time in seconds after --start"),
        (["--start", "9"], "--start 9 is behind the end of the video"),
    ):
        assert main([*given, *more]) != 0 and said in capsys.readouterr().err
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").touch()
    assert main(given) != 0 and "is not empty" in capsys.readouterr().err


def test_one_camera_is_refused_at_once(raw: Path, tmp_path: Path, demo_head_model: Path) -> None:
    folder = changed(raw, tmp_path, lambda _: None)
    for serial in SERIALS[1:]:
        (folder / "images" / f"cam_{serial}.mp4").unlink()
    with pytest.raises(UserError, match="has pictures of one calibrated camera; two at least .*: copy the others"):
        track_rig.track_rig([folder], tmp_path / "out", demo_head_model, load_head_assets(demo_head_model))
