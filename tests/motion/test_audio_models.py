"""What models of speech and other trackers write, as drive files: Audio2Face, LAM_Audio2Expression, VHAP, SMIRK."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from heads import grid_head

from avatar.errors import UserError
from avatar.head.expression_names import ExpressionNames
from avatar.head.model import matrix_from_6d
from avatar.motion.drive import Drive
from avatar.motion.drive_file import read_drive

ASSETS = replace(grid_head(), names=ExpressionNames(("mouthSmile_L", "mouthSmile_R", None, None, None)))


def read(path: Path) -> tuple[Drive, str]:
    said: list[str] = []
    return read_drive(path, ASSETS, 64, said.append), "\n".join(said)


def test_audio2faces_table(tmp_path: Path) -> None:
    """As pandas writes it for NVIDIA's client: numbered lines, times in seconds, names with a prefix."""
    names = ["EyeBlinkLeft", "JawOpen", "MouthSmileLeft"]
    lines = [",".join(["", "timeCode", *(f"blendShapes.{name}" for name in names)])]
    lines += [f"{i},{i / 30},0.25,1.0,{i / 100}" for i in range(40)]
    (tmp_path / "animation_frames.csv").write_text("\n".join(lines))
    drive, said = read(tmp_path / "animation_frames.csv")
    assert drive.fps == 30 and len(drive) == 40 and "its column timeCode, seconds" in said
    assert float(drive.params[7].expression[0]) == pytest.approx(0.07)
    assert drive.params[7].eyelids.tolist() == [0.25, 0]
    assert float(matrix_from_6d(drive.params[7].jaw)[2, 1]) == pytest.approx(math.sin(0.35), abs=1e-6)


def blendshapes(**changes: Any) -> dict[str, Any]:
    frames = [{"weights": [0.5, 0.25, i / 10, 0.0], "time": i / 30, "rotation": []} for i in range(3)]
    names = ["jawOpen", "eyeBlinkLeft", "mouthSmileLeft", "tongueOut"]
    return {"names": names, "metadata": {"fps": 30.0, "frame_count": 3}, "frames": frames} | changes


def test_lams_blendshapes(tmp_path: Path) -> None:
    (tmp_path / "bsData.json").write_text(json.dumps(blendshapes()))
    drive, said = read(tmp_path / "bsData.json")
    assert drive.fps == 30 and [float(p.expression[0]) for p in drive.params] == pytest.approx([0, 0.1, 0.2])
    assert drive.params[0].eyelids.tolist() == [0.25, 0] and "bsData.json: 3 frames, 30 a second" in said
    assert float(matrix_from_6d(drive.params[0].jaw)[2, 1]) == pytest.approx(math.sin(0.175), abs=1e-6)
    assert "move nothing on this head model: tongueOut" in said


FRAME = {"weights": [0, 0, 0, 0]}
BAD: dict[str, tuple[Any, str]] = {
    "a list": ([1], 'needs "names"'),
    "names of numbers": (blendshapes(names=[1]), 'needs "names"'),
    "no names": (blendshapes(names=[]), 'needs "names"'),
    "a name twice": (blendshapes(names=["jawOpen", "JawOpen"]), "two of its names are the same"),
    "no frame": (blendshapes(frames=[]), 'needs "frames"'),
    "no rate": (blendshapes(metadata=3), '"fps" in "metadata" is not a finite number'),
    "no frames in a second": (blendshapes(metadata={"fps": 0}), "fps is 0"),
    "a frame that is none": (blendshapes(frames=[FRAME, 3]), 'frame 1 needs "weights", 4 numbers'),
    "too few weights": (blendshapes(frames=[FRAME, {"weights": [1]}]), 'frame 1 needs "weights", 4 numbers'),
    "text": (blendshapes(frames=[{"weights": ["1", 0, 0, 0]}]), "a weight of frame 0 is not a finite number"),
    "NaN": (blendshapes(frames=[{"weights": [math.nan, 0, 0, 0]}]), "a weight of frame 0 is not a finite number"),
    "percent": (blendshapes(frames=[{"weights": [87, 0, 0, 0]}]), "a weight of frame 0 lies beyond +-10"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_bad_blendshapes_get_one_sentence(mistake: str, tmp_path: Path) -> None:
    content, sentence = BAD[mistake]
    (tmp_path / "bad.json").write_text(json.dumps(content))
    with pytest.raises(UserError) as caught:
        read(tmp_path / "bad.json")
    assert sentence in str(caught.value) and "bad.json" in str(caught.value) and "\n" not in str(caught.value)


def test_vhaps_parameters(tmp_path: Path) -> None:
    turn, T = np.array([[0.2, 0.0, 0.0]]), 2
    np.savez(
        tmp_path / "tracked_flame_params_30.npz",
        expr=np.full((T, 5), 0.5, np.float32),
        jaw_pose=turn.repeat(T, axis=0),
        eyes_pose=np.tile(turn, (T, 2)),
        neck_pose=-turn.repeat(T, axis=0),
        rotation=np.zeros((T, 3)),
        translation=np.zeros((T, 3)),
        shape=np.full((1, 300), 0.1),
        static_offset=np.zeros((1, 4, 3)),
        timestep_id=np.array(["0", "1"]),
    )
    drive, said = read(tmp_path / "tracked_flame_params_30.npz")
    assert drive.params[1].expression.tolist() == [0.5] * 5 and drive.cameras is None and len(drive.identity) == 300
    for joint, sine in (("jaw", 0.2), ("eyes", 0.2), ("neck", -0.2)):
        turns = matrix_from_6d(getattr(drive.params[1], joint).reshape(-1, 6))
        torch.testing.assert_close(turns[:, 2, 1], torch.full((len(turns),), math.sin(sine)))
    assert "also holds rotation, static_offset, timestep_id, translation" in said


def test_smirks_parameters(tmp_path: Path) -> None:
    T = 2
    np.savez(
        tmp_path / "smirk.npz",
        pose_params=np.zeros((T, 3), np.float32),
        cam=np.zeros((T, 3), np.float32),
        shape_params=np.zeros((T, 300), np.float32),
        expression_params=np.full((T, 5), 0.5, np.float32),
        eyelid_params=np.tile(np.array([0.25, 0.75], np.float32), (T, 1)),
        jaw_params=np.tile(np.array([0.2, 0.0, 0.0], np.float32), (T, 1)),
    )
    drive, said = read(tmp_path / "smirk.npz")
    assert drive.params[1].expression.tolist() == [0.5] * 5 and drive.params[1].eyelids.tolist() == [0.25, 0.75]
    assert float(matrix_from_6d(drive.params[1].jaw)[2, 1]) == pytest.approx(math.sin(0.2), abs=1e-6)
    assert "also holds cam, pose_params, shape_params" in said


def test_a_drive_file_with_two_expressions_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "two.npz", expr=np.zeros((2, 5), np.float32), expression_params=np.ones((2, 5), np.float32))
    with pytest.raises(UserError, match="two.npz holds expression twice, as expr and expression_params"):
        read(tmp_path / "two.npz")
