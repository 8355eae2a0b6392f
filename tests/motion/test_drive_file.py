from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from heads import EXPRESSIONS, grid_head, random_params

from avatar.errors import UserError
from avatar.head.expression_names import ExpressionNames, load_expression_names
from avatar.head.model import matrix_from_6d
from avatar.motion.drive import Drive
from avatar.motion.drive_file import read_drive, write_drive
from avatar.types import Camera

ASSETS = grid_head()
NAMES = ExpressionNames(("mouthSmile_L", "mouthSmile_R", "browInnerUp_L", "browInnerUp_R", None))


def read(path: Path, names: ExpressionNames = NAMES, width: int = 64) -> tuple[Drive, str]:
    said: list[str] = []
    return read_drive(path, replace(ASSETS, names=names), width, said.append), "\n".join(said)


def npz(path: Path, **arrays: object) -> Path:
    np.savez(path, **{name: np.asarray(value) for name, value in arrays.items()})
    return path


def csv(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    cameras = [Camera(torch.eye(3), torch.tensor([0, 0, 1.0 + i]), 200, 210, 63, 50, 128, 96) for i in range(3)]
    params = [random_params(seed) for seed in range(3)]
    drive = Drive("d", 30.0, ("a", "b", "c"), params, cameras, torch.tensor([0.5, -1.0]))
    write_drive(tmp_path / "d.npz", drive, ASSETS.fingerprint)
    found, said = read(tmp_path / "d.npz", width=128)
    assert said == "" and (found.name, found.fps, found.names) == ("d", 30.0, ("a", "b", "c"))
    assert torch.equal(found.identity, drive.identity)
    for a, b in zip(found.params, drive.params, strict=True):
        for name in ("expression", "jaw", "eyes", "eyelids", "neck"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert found.cameras is not None
    for a, b in zip(found.cameras, cameras, strict=True):
        assert (a.fx, a.fy, a.cx, a.cy, a.width, a.height) == (200, 210, 63, 50, 128, 96)
        assert torch.equal(a.t_cam_world, b.t_cam_world)
    with np.load(tmp_path / "d.npz") as file:
        assert file["K"].tolist() == [[200, 0, 63], [0, 210, 50], [0, 0, 1]] and file["size"].tolist() == [128, 96]
    smaller, _ = read(tmp_path / "d.npz", width=64)
    assert smaller.cameras is not None
    assert (smaller.cameras[0].width, smaller.cameras[0].height, smaller.cameras[0].fx) == (64, 48, 100)


def test_frames_whose_names_are_not_utf_8_are_read_back_under_names_that_are(tmp_path: Path) -> None:
    drive = Drive("d", 30.0, ("caf\udce9_1", "b"), [random_params(seed) for seed in range(2)], None, torch.zeros(0))
    write_drive(tmp_path / "d.npz", drive, ASSETS.fingerprint)
    assert read(tmp_path / "d.npz")[0].names == (r"caf\udce9_1", "b")


def test_little_is_enough_and_short_vectors_are_padded_aloud(tmp_path: Path) -> None:
    drive, said = read(npz(tmp_path / "d.npz", expression=[[1.0, 2.0], [3.0, 4.0]], jaw=[[0.2, 0, 0], [0, 0, 0]]))
    assert "has 2 of 5 expression coefficients; the rest are zero" in said
    assert drive.params[1].expression.tolist() == [3, 4, 0, 0, 0]
    assert (drive.fps, drive.cameras, drive.names) == (25.0, None, ("00000", "00001"))
    R = matrix_from_6d(drive.params[0].jaw)
    assert float(R[2, 1]) == pytest.approx(math.sin(0.2)) and float(R[1, 2]) == pytest.approx(-math.sin(0.2))
    assert torch.equal(matrix_from_6d(drive.params[0].eyes.reshape(2, 6)), torch.eye(3).repeat(2, 1, 1))
    long = np.zeros((1, EXPRESSIONS + 3))
    long[0, 0] = 1.0
    assert read(npz(tmp_path / "long.npz", expression=long))[0].params[0].expression.tolist() == [1, 0, 0, 0, 0]


def test_a_jaw_that_no_vertex_follows_is_said(tmp_path: Path) -> None:
    weights = ASSETS.weights.clone()
    weights[:, 0] += weights[:, 2]
    weights[:, 2] = 0.0
    fixed = replace(ASSETS, weights=weights, pose_dirs=torch.zeros_like(ASSETS.pose_dirs))
    assert "jaw" in fixed.fixed_joints and "jaw" not in ASSETS.fixed_joints
    turned = npz(tmp_path / "d.npz", expression=FINE, jaw=[[0, 0, 0], [0.2, 0, 0]])
    still = npz(tmp_path / "still.npz", expression=FINE, jaw=np.zeros((2, 3)))
    for assets, path, warns in ((fixed, turned, True), (fixed, still, False), (ASSETS, turned, False)):
        said: list[str] = []
        read_drive(path, assets, 64, said.append)
        assert any("no vertex of the avatar's head model follows its jaw" in line for line in said) == warns


FINE = np.zeros((2, EXPRESSIONS))
CAMERA = {"R": np.tile(np.eye(3), (2, 1, 1)), "t": np.ones((2, 3)), "K": np.eye(3), "size": [64, 64]}
BAD = {
    "nothing": ({"x": FINE}, "holds no expression (it holds x)"),
    "jaw alone": ({"jaw": np.zeros((2, 3))}, "holds no expression (it holds jaw)"),
    "degrees": ({"expression": FINE, "jaw": [[0, 0, 0], [20, 0, 0]]}, "jaw of frame 1 turns by 20 radians"),
    "no frame": ({"expression": np.zeros((0, 5))}, "has 0 frames"),
    "flat": ({"expression": np.zeros(5)}, "expression has shape [5], expected [any, any]"),
    "text": ({"expression": np.array([["a"]])}, "expression holds <U1 values, not real numbers"),
    "complex": ({"expression": np.zeros((1, 5), complex)}, "expression holds complex128 values"),
    "NaN": ({"expression": np.where(np.eye(2, 5) > 0, np.nan, 0)}, "expression[0, 0] is nan"),
    "huge": ({"expression": FINE + 1e30}, "numbers must lie within +-10000"),
    "too many": ({"expression": np.ones((1, 9))}, "has 9 expression coefficients, but the avatar's head model has 5"),
    "other length": ({"expression": FINE, "eyelids": np.zeros((3, 2))}, "eyelids has shape [3, 2], expected [2, 2]"),
    "jaw of four": (
        {"expression": FINE, "jaw": np.zeros((2, 4))},
        "jaw has 4 values a frame; 3 (rotation vectors) or 6",
    ),
    "no rotation": ({"expression": FINE, "jaw": np.zeros((2, 6))}, "jaw of frame 0 is not a rotation"),
    "a rate that is none": ({"expression": FINE, "fps": np.nan}, "fps is nan"),
    "a rate beyond any": ({"expression": FINE, "fps": 1e308}, "fps is 1e+308"),
    "a rate beyond float64": ({"expression": FINE, "fps": np.longdouble("1e4000")}, "fps is inf"),
    "a negative rate": ({"expression": FINE, "fps": -25.0}, "fps is -25, frames a second; it must lie between 1"),
    "places beyond float64": (
        {"expression": FINE, **CAMERA, "t": np.full((2, 3), np.longdouble("1e4000"))},
        "t[0, 0] is inf",
    ),
    "no time": ({"expression": FINE, "fps": 0.0}, "fps is 0, frames a second; it must lie between 1"),
    "other head": ({"expression": FINE, "head": "f00d"}, "was made for another head model"),
    "a list of heads": ({"expression": FINE, "head": ["f00d"]}, "head must be one text"),
    "a number for a head": ({"expression": FINE, "head": 1}, "head must be one text"),
    "half a camera": ({"expression": FINE, "R": CAMERA["R"]}, "has a camera without t, K, size"),
    "mirror": ({"expression": FINE, **CAMERA, "R": -CAMERA["R"]}, "R of frame 0 is not a rotation"),
    "no picture": ({"expression": FINE, **CAMERA, "size": [0, 64]}, "the camera has size 0x64"),
    "needle": ({"expression": FINE, **CAMERA, "size": [1, 9999]}, "too narrow"),
    "names": ({"expression": FINE, "names": ["a"]}, "names must hold one text per frame, [2]"),
    "shape": ({"expression": FINE, "shape": np.zeros(301)}, "shape has 301 values, the head model 300"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_npz_gets_one_sentence(mistake: str, tmp_path: Path) -> None:
    arrays, sentence = BAD[mistake]
    with pytest.raises(UserError) as caught:
        read(npz(tmp_path / "bad.npz", **arrays))
    assert sentence in str(caught.value) and "bad.npz" in str(caught.value)


def test_files_that_are_no_npz_or_would_execute_code_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "pickled.npz", expression=np.array([{"a": 1}], dtype=object))
    with pytest.raises(UserError, match="pickled Python objects"):
        read(tmp_path / "pickled.npz")
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps([1, 2]))
    whole = npz(tmp_path / "whole.npz", expression=FINE).read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    for name in ("pickle.npz", "cut.npz"):
        with pytest.raises(UserError, match="damaged or not a .npz file"):
            read(tmp_path / name)
    with pytest.raises(UserError, match="does not exist"):
        read(tmp_path / "gone.npz")
    _, said = read(npz(tmp_path / "more.npz", expression=FINE, expresion=FINE))
    assert "also holds expresion" in said


def test_a_csv_by_number_and_by_name(tmp_path: Path) -> None:
    header = "time,expression_4,mouth_smile_left,jaw_x,jaw_y,jaw_z,eyelid_left,eyelid_right,mood\n"
    drive, said = read(csv(tmp_path / "d.csv", header + "0,1,2,0.1,0,0,0.5,1,9\n0.02,3,4,0,0,0,0,0,9\n"))
    assert [p.expression.tolist() for p in drive.params] == [[2, 0, 0, 0, 1], [4, 0, 0, 0, 3]]
    assert drive.fps == pytest.approx(50.0) and drive.params[0].eyelids.tolist() == [0.5, 1.0]
    assert float(matrix_from_6d(drive.params[0].jaw)[2, 1]) == pytest.approx(math.sin(0.1))
    assert "left unread in d.csv: mood" in said


BAD_CSV = {
    "empty": ("", "needs a line of column names and at least one frame"),
    "no frame": ("expression_0\n", "needs a line of column names and at least one frame"),
    "no expression": ("a,b\n1,2\n", "has no column expression_0"),
    "no names": ("\n0,0,0.5\n1,1,0.25\n", "line 2 holds numbers: the first line must name the columns"),
    "ragged": ("expression_0,expression_1\n1\n", "line 2: 1 values for 2 columns"),
    "text": ("expression_0\n1\nx\n", "line 3: expression_0 is 'x', not a finite number"),
    "infinite": ("expression_0\ninf\n", "line 2: expression_0 is 'inf'"),
    "beyond": ("expression_7\n1\n", "expression_7 is beyond the head model's 5 coefficients"),
    "twice": ("expression_0,Expression_0\n1,2\n", "two columns of the name expression0"),
    "same": ("expression_0,mouthSmile_L\n1,2\n", "expression_0 and mouthSmile_L are the same coefficient"),
    "half a jaw": ("expression_0,jaw_x\n1,2\n", "has jaw_x but not all of jaw_x, jaw_y, jaw_z"),
    "back in time": ("time,expression_0\n1,0\n1,0\n", "the column time must rise"),
    "quotes": ('expression_0\n"1\n', "cannot be read as CSV"),
}


@pytest.mark.parametrize("mistake", BAD_CSV)
def test_a_bad_csv_gets_one_sentence(mistake: str, tmp_path: Path) -> None:
    text, sentence = BAD_CSV[mistake]
    with pytest.raises(UserError) as caught:
        read(csv(tmp_path / "bad.csv", text))
    assert sentence in str(caught.value) and "bad.csv" in str(caught.value)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_bytes(b"\x80\xfe\x00\x81" * 40)
    with pytest.raises(UserError, match="cannot be read as CSV"):
        read(tmp_path / "bad.csv")


def live_link(path: Path, frames: int = 150, **values: float) -> Path:
    """As Live Link Face writes it, 60 frames a second, with these blendshapes at these values in every frame."""
    names = ["EyeBlinkLeft", "EyeBlinkRight", "EyeLookOutLeft", "EyeLookInRight", "EyeLookDownLeft", "JawOpen"]
    names += ["MouthSmileLeft", "MouthSmileRight", "BrowInnerUp", "TongueOut", "HeadYaw", "LeftEyeYaw"]
    lines = [",".join(["Timecode", "BlendShapeCount", *names])]
    for frame in range(frames):
        seconds, rest = divmod(frame + 20, 60)
        code = f"15:42:{30 + seconds}:{rest:02d}.123"
        lines.append(",".join([code, "61", *(f"{values.get(name, 0.0):.6f}" for name in names)]))
    return csv(path, "\n".join(lines) + "\n")


def test_a_phones_recording_moves_what_the_head_model_names(tmp_path: Path) -> None:
    file = live_link(
        tmp_path / "phone.csv", EyeBlinkLeft=0.7, MouthSmileLeft=0.5, BrowInnerUp=0.25, JawOpen=1.0, EyeLookOutLeft=0.5
    )
    drive, said = read(file)
    params = drive.params[0]
    assert len(drive) == 150 and drive.fps == 60.0 and drive.cameras is None
    assert params.eyelids.tolist() == pytest.approx([0.7, 0.0])
    assert params.expression.tolist() == pytest.approx([0.5, 0, 0.25, 0.25, 0])
    assert float(matrix_from_6d(params.jaw)[2, 1]) == pytest.approx(math.sin(0.35), abs=1e-6)
    left, right = matrix_from_6d(params.eyes.reshape(2, 6))
    # Rotation about y towards the subject's left by half of 0.6 radians; the other eye stays.
    assert float(left[0, 2]) == pytest.approx(math.sin(0.3), abs=1e-6)
    torch.testing.assert_close(right, torch.eye(3))
    assert "1 of ARKit's blendshapes move nothing on this head model: TongueOut" in said
    assert "the head's turns in phone.csv are not used" in said


def test_a_coefficients_own_name_beside_arkits_blendshapes_moves_it(tmp_path: Path) -> None:
    drive, said = read(csv(tmp_path / "phone.csv", "JawOpen,grin,take\n0,0.5,1\n"), ExpressionNames((None, "grin")))
    assert drive.params[0].expression.tolist() == [0, 0.5, 0, 0, 0] and "left unread in phone.csv: take" in said


def test_arkits_weights_beside_the_head_model_win(tmp_path: Path) -> None:
    names = {"names": ["grin", None], "arkit": {"MouthSmileLeft": {"grin": 0.5, "4": -1.0}, "JawOpen": {"jaw_x": 0.1}}}
    (tmp_path / "generic_model.npz").write_bytes(b"")
    (tmp_path / "expression_names.json").write_text(json.dumps(names))
    loaded = load_expression_names(tmp_path, EXPRESSIONS)
    drive, _ = read(live_link(tmp_path / "phone.csv", MouthSmileLeft=1.0, JawOpen=1.0), loaded)
    assert drive.params[0].expression.tolist() == pytest.approx([0.5, 0, 0, 0, -1.0])
    assert float(matrix_from_6d(drive.params[0].jaw)[2, 1]) == pytest.approx(math.sin(0.1), abs=1e-6)


def test_a_head_model_without_names_says_what_is_needed(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="put expression_names.json beside the model file"):
        read(live_link(tmp_path / "phone.csv", MouthSmileLeft=1.0), ExpressionNames())
    (tmp_path / "generic_model.npz").write_bytes(b"")
    assert load_expression_names(tmp_path, EXPRESSIONS) == ExpressionNames()


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "cannot be read as JSON"),
        ('{"names": 3}', 'must hold "names"'),
        ('["a", 1]', 'must hold "names"'),
        (json.dumps(["a"] * 6), "names 6 coefficients, but the head model has 5"),
        ('{"names": [], "arkit": {"JawOpen": 1}}', "an object of weights"),
        ('{"names": [], "arkit": {"JawOpen": {"nose": 1}}}', "moves 'nose', which is no coefficient"),
        ('{"names": [], "arkit": {"JawOpen": {"5": 1}}}', "moves '5', which is no coefficient"),
        ('{"names": [], "arkit": {"JawOpen": {"0": NaN}}}', "is nan, not a number"),
    ],
)
def test_bad_names_get_one_sentence(content: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "generic_model.npz").write_bytes(b"")
    (tmp_path / "expression_names.json").write_text(content)
    with pytest.raises(UserError) as caught:
        load_expression_names(tmp_path, EXPRESSIONS)
    assert sentence in str(caught.value)
