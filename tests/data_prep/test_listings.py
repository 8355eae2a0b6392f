"""Listings with something wrong, and files that are none: one sentence each."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from exports import write_vhap
from importing import import_folder

from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.formats.frame_track import BadFrame
from data_prep.formats.vhap import _static_offset

Edit = Callable[[dict], object]


def edit_frame(**values: object) -> Edit:
    return lambda listing: listing["frames"][5].update(values)


def edit_all(**values: object) -> Edit:
    return lambda listing: [entry.update(values) for entry in listing["frames"]]


NAN = float("nan")
BAD_LISTINGS: dict[str, tuple[Edit, str]] = {
    "path up": (
        edit_frame(file_path="../x.png"),
        r"file_path of frame 5 is '../x.png', which leaves .*vhap; give",
    ),
    "path absolute": (
        edit_frame(flame_param_path="/etc/passwd"),
        r"flame_param_path of frame 5 is '/etc/passwd', which",
    ),
    "path of Windows": (
        edit_frame(fg_mask_path="C:\\x.png"),
        r"fg_mask_path of frame 5 is 'C:\\\\x.png', which leaves",
    ),
    "path is a number": (edit_frame(file_path=7), r"transforms.json: file_path of frame 5 is not a path"),
    "path missing": (edit_frame(file_path=None), r"transforms.json: frame 5 has no file_path"),
    "parameters missing": (
        edit_frame(flame_param_path=None),
        r"frame 5 has no flame_param_path; export the folder again",
    ),
    "image twice": (
        edit_frame(file_path="images/00003_00.png"),
        r"frames 3 and 5 are both images/00003_00.png; remove",
    ),
    "frames is no list": (lambda li: li.update(frames=3), r"transforms.json has no list of at most 200000 frames"),
    "a frame is no object": (lambda li: li["frames"].append([1]), r"frame 24 is not an object with values"),
    "focal length not finite": (
        lambda li: li.update(fl_x=NAN),
        r"24 of 24 tracking files .*fl_x is not finite \(1 of 1",
    ),
    "focal length negative": (lambda li: li.update(fl_x=-100.0), r"focal lengths fl_x and fl_y are not positive"),
    "no focal length": (lambda li: li.pop("fl_x"), r"camera_angle_x is missing in transforms.json"),
    "size absurd": (lambda li: li.update(w=1e9), r"w and h are 1e\+09 and 56, which no image is"),
    "tracked at another size": (
        lambda li: li.update(w=640, h=560),
        r"made on 640x560 images, but those in .*images are",
    ),
    "pose not finite": (
        edit_all(transform_matrix=[[NAN] * 4] * 4),
        r"transform_matrix is not finite \(16 of 16 values\)",
    ),
    "pose ragged": (edit_all(transform_matrix=[[1, 2], [3]]), r"transform_matrix is not numbers"),
    "pose of text": (edit_all(transform_matrix=["1"] * 16), r"transform_matrix is not numbers"),
    "pose too short": (edit_all(transform_matrix=[1.0] * 12), r"transform_matrix has 12 values, not 16"),
    "pose scaled": (edit_all(transform_matrix=np.diag([2, 2, 2, 1]).tolist()), r"transform_matrix is not a rotation"),
    "pose projective": (
        edit_all(transform_matrix=np.ones((4, 4)).tolist()),
        r"the last row of transform_matrix is not 0",
    ),
    "image missing": (edit_all(file_path="images/a.png"), r"are both images/a.png"),
    "camera changes": (edit_frame(fl_x=999.0), r"the intrinsics change within the clip"),
}


@pytest.mark.parametrize("name", BAD_LISTINGS)
def test_bad_listing(name: str, tracked: Path, tmp_path: Path) -> None:
    edit, sentence = BAD_LISTINGS[name]
    folder = write_vhap(tracked, tmp_path / "vhap", divided=False)
    listing = json.loads((folder / "transforms.json").read_text())
    edit(listing)
    (folder / "transforms.json").write_text(json.dumps(listing))
    with pytest.raises(UserError, match=sentence) as error:
        import_folder(folder, tracked, tmp_path / "out")
    assert "\n" not in str(error.value) and {path.name for path in tmp_path.iterdir()} == {"vhap"}


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", r"transforms.json cannot be read as JSON"),
        (b"[" * 100_000, r"transforms.json cannot be read as JSON"),
        (b'{"frames": [' + b"9" * 5000 + b"]}", r"transforms.json cannot be read as JSON"),
        (b"\xff\xfe\x00", r"transforms.json cannot be read as JSON"),
        (b"[]", r"transforms.json has no list of at most"),
        (
            json.dumps({"frames": [{"file_path": "a", "expression": [0] * 76, "transform_matrix": []}]}).encode(),
            r"its `expression` is not FLAME's, as in NeRFace's data; track the video with one of the programs below: ",
        ),
        (json.dumps({"frames": [{"file_path": "a"}]}).encode(), r"it has no FLAME parameters of VHAP, INSTA, IMavatar"),
    ],
)
def test_a_file_that_is_no_listing(content: bytes, sentence: str, tracked: Path, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "transforms.json").write_bytes(content)
    with pytest.raises(UserError, match=sentence):
        import_folder(tmp_path / "folder", tracked, tmp_path / "out")


@pytest.mark.parametrize("change", [-1, 1000])
def test_a_static_offset_of_another_head_is_refused(change: int, tracked: Path, tmp_path: Path) -> None:
    vertices = load_head_assets(tracked / "head_model").num_vertices

    def of_another_head(_: int, values: dict[str, np.ndarray]) -> None:
        values["static_offset"] = np.zeros((1, vertices + change, 3))

    folder = write_vhap(tracked, tmp_path / "vhap", divided=False, edit=of_another_head)
    counts = f"static_offset in 00000.npz has {vertices + change} vertices and the head model {vertices}"
    with pytest.raises(UserError, match=counts) as error:
        import_folder(folder, tracked, tmp_path / "out")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (30, None),
        (57, None),
        (27, "has 9 vertices and the head model 10"),
        (60, "has 20 vertices"),
        (31, "has 31 values"),
    ],
)
def test_a_static_offset_is_of_the_heads_vertices_and_perhaps_of_teeth(values: int, sentence: str | None) -> None:
    if sentence is None:
        assert _static_offset(np.arange(values, dtype=float), 10, "a.npz")[1].tolist() == [3.0, 4.0, 5.0]
    else:
        with pytest.raises(BadFrame, match=f"static_offset in a.npz {sentence}"):
            _static_offset(np.arange(values, dtype=float), 10, "a.npz")
