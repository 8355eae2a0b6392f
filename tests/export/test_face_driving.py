"""A face's scores and pose move the avatar of browsers as they move the program's own, no farther than training showed."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from browsers import node
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from lively import lively_avatar

from avatar.export.default_view import front_camera
from avatar.export.web_page import write_web_avatar
from avatar.head.model import matrix_from_6d
from avatar.motion.neutral_pose import RestPose
from avatar.motion.transfer import retargeted
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import HeadParams
from avatar.view.packets import BLENDSHAPES, FrameReader
from avatar.view.webcam import moved_camera

HERE = Path(__file__).parent
NAMES = [name[0].lower() + name[1:] for name in BLENDSHAPES]
OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


class Place(NamedTuple):
    """A tracked head, as `avatar.view.webcam` knows it."""

    R_cam_head: torch.Tensor
    t_cam_head: torch.Tensor
    params: HeadParams
    taken: float = 0.0


WEIGHTS = {
    "names": [
        "jaw_back",
        "smile_left",
        "smile_right",
        "pucker",
        "mouth_left",
        "BrowInnerUp",
        "sneer_left",
        None,
        None,
        None,
    ],
    "arkit": {
        "MouthSmileLeft": {"smile_left": 1.0, "7": 0.2},
        "MouthSmileRight": {"smile_right": 0.9},
        "MouthLeft": {"mouth_left": 1.0},
        "MouthRight": {"mouth_left": -1.0},
        "MouthPucker": {"pucker": 1.1},
        "JawOpen": {"jaw_x": 0.3, "8": 0.4},
    },
}


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    """Its head model says what ARKit's names are on it."""
    folder = tmp_path_factory.mktemp("named")
    shutil.copytree(tracked_folder, folder / "someone")
    (folder / "someone" / "head_model" / "expression_names.json").write_text(json.dumps(WEIGHTS))
    return lively_avatar(folder / "someone", folder / "run", "model.uv_size=12")


@pytest.fixture(scope="module")
def nameless(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run", "model.uv_size=12")


def driven(trained: TrainedAvatar, folder: Path, **given: Any) -> dict[str, Any]:
    write_web_avatar(trained, folder / "a.avatar", "float")
    (folder / "faces.json").write_text(json.dumps({"neutral": None, "faces": [], "widely": True} | given))
    return node(HERE / "drive.mjs", folder / "a.avatar", folder / "faces.json")


def scores(generator: np.random.Generator, high: float = 0.5) -> dict[str, float]:
    return {name: float(value) for name, value in zip(NAMES, generator.uniform(0, high, len(NAMES)), strict=True)}


def place(trained: TrainedAvatar, turn: tuple[float, float, float], at: tuple[float, float, float]) -> Place:
    R = OPENGL @ axis_angle_to_rotation_matrix(torch.tensor([turn]))[0]
    return Place(R, torch.tensor(at), trained.rest_params())


def as_landmarker(place: Place) -> list[float]:
    """4x4 by columns, in centimetres, OpenGL's axes."""
    matrix = torch.eye(4)
    matrix[:3, :3] = OPENGL @ place.R_cam_head
    matrix[:3, 3] = 100 * (OPENGL @ place.t_cam_head)
    return matrix.T.flatten().tolist()


def test_scores_move_the_face_as_in_the_program(trained: TrainedAvatar, tmp_path: Path) -> None:
    """As a stream's blendshapes do after its neutral face has been taken."""
    generator = np.random.default_rng(0)
    neutral, faces = scores(generator, 0.2), [scores(generator) for _ in range(6)]
    for name in NAMES:  # gaze and lids are no departures there
        if name.startswith(("eyeLook", "eyeBlink")):
            neutral[name] = 0.0
    found = driven(
        trained,
        tmp_path,
        neutral={"scores": neutral, "matrix": None},
        faces=[{"scores": face, "matrix": None} for face in faces],
    )
    reader = FrameReader(trained.assets)
    frames = [reader.line(json.dumps({"blendshapes": face}).encode())[0] for face in (neutral, *faces)]
    source = RestPose(frames[0].expression, matrix_from_6d(frames[0].jaw), None)
    goal = RestPose(trained.neutral.expression, trained.neutral.jaw, None)
    rest = torch.tensor(found["rest"])
    for pose, params in zip(found["poses"], retargeted(frames[1:], source, goal, 1.0), strict=True):
        expected = torch.cat((params.expression, params.jaw, params.eyes, params.eyelids, params.neck))
        torch.testing.assert_close(torch.tensor(pose["parameters"]), expected, atol=2e-5, rtol=0)
        assert (expected - rest)[: len(params.expression)].abs().max() > 0.1, "it moves"
        assert pose["rotation"] == found["camera"]["rotation"]


def test_nothing_goes_farther_than_in_training(trained: TrainedAvatar, tmp_path: Path) -> None:
    many = {"scores": dict.fromkeys(NAMES, 50.0), "matrix": None}
    found = driven(trained, tmp_path, faces=[many], widely=False)
    E = trained.assets.num_expressions
    low, high = (np.array(found["limits"][side]) for side in ("low", "high"))
    moved = np.array(found["poses"][0]["parameters"]) - np.array(found["rest"])
    assert (moved[:E] <= high[:E] + 1e-5).all() and (moved[:E] >= low[:E] - 1e-5).all()
    assert np.abs(moved[:E]).max() > 0.05
    shown = trained.recording.tracks["expression"][list(trained.recording.split.train)] - trained.neutral.expression
    assert np.allclose(high[:E], np.maximum(np.percentile(shown.double().numpy(), 99, axis=0), 0), atol=1e-5)
    lids = trained.recording.tracks["eyelids"][list(trained.recording.split.train)].double().numpy()
    assert np.allclose(high[E + 9 :], np.maximum(np.percentile(lids, 99, axis=0), 0), atol=1e-5)
    assert np.allclose(np.array(found["poses"][0]["parameters"])[E + 18 : E + 20], high[E + 9 :])


def test_lids_that_are_a_little_down_at_rest_still_close(trained: TrainedAvatar, tmp_path: Path) -> None:
    faces = [{"scores": {"eyeBlinkLeft": left, "eyeBlinkRight": 0.0}, "matrix": None} for left in (0.4, 0.7, 1.0, 0.1)]
    found = driven(trained, tmp_path, neutral={"scores": {"eyeBlinkLeft": 0.4}, "matrix": None}, faces=faces)
    at = trained.assets.num_expressions + 18
    assert [pose["parameters"][at] for pose in found["poses"]] == pytest.approx([0, 0.5, 1, 0], abs=1e-6)
    assert all(pose["parameters"][at + 1] == 0 for pose in found["poses"])


def test_the_head_turns_and_moves_as_in_the_program(trained: TrainedAvatar, tmp_path: Path) -> None:
    """But to the side as far as the person does, whatever the lenses."""
    rest = place(trained, (0.05, -0.1, 0.02), (0.02, -0.01, 0.6))
    places = [
        place(trained, (0.05, 0.2, 0.02), (0.02, -0.01, 0.6)),
        place(trained, (-0.2, -0.1, 0.3), (0.02, -0.01, 0.6)),
        place(trained, (0.1, -0.3, -0.1), (0.03, -0.02, 0.66)),
    ]
    faces = [{"scores": {}, "matrix": as_landmarker(each)} for each in places]
    found = driven(trained, tmp_path, neutral={"scores": {}, "matrix": as_landmarker(rest)}, faces=faces)
    for pose, each in zip(found["poses"], places, strict=True):
        expected = moved_camera(front_camera(trained), rest, each)
        torch.testing.assert_close(
            torch.tensor(pose["rotation"]).reshape(3, 3), expected.R_cam_world, atol=1e-4, rtol=0
        )
        assert pose["translation"][2] == pytest.approx(float(expected.t_cam_world[2]), abs=1e-4)
        shift = torch.tensor(pose["translation"])[:2] - front_camera(trained).t_cam_world[:2]
        torch.testing.assert_close(shift, (each.t_cam_head - rest.t_cam_head)[:2], atol=1e-4, rtol=0)


def test_the_network_of_an_avatar_of_several_cameras_is_told_how_the_head_turns(
    trained: TrainedAvatar, tmp_path: Path
) -> None:
    rest, other = (place(trained, turn, (0.0, 0.0, 0.6)) for turn in ((0.05, -0.1, 0.02), (-0.2, 0.3, 0.1)))
    reference = axis_angle_to_rotation_matrix(torch.tensor([[0.1, -0.4, 0.2]]))[0]
    own = replace(front_camera(trained), R_ref_cam=reference)
    found = driven(
        trained,
        tmp_path,
        head=own.head_rotation.flatten().tolist(),
        neutral={"scores": {}, "matrix": as_landmarker(rest)},
        faces=[{"scores": {}, "matrix": as_landmarker(other)}],
    )
    expected = moved_camera(own, rest, other).head_rotation
    torch.testing.assert_close(
        torch.tensor(found["poses"][0].get("head", [0.0] * 9)).reshape(3, 3), expected, atol=1e-4, rtol=0
    )


def test_the_head_stays_in_the_picture_and_in_what_training_showed(trained: TrainedAvatar, tmp_path: Path) -> None:
    rest = place(trained, (0.0, 0.0, 0.0), (0.0, 0.0, 0.6))
    away = place(trained, (0.0, 1.4, 0.0), (3.0, -3.0, 5.0))
    first = {"scores": {}, "matrix": as_landmarker(rest)}
    found = driven(trained, tmp_path, faces=[first, {"scores": {}, "matrix": as_landmarker(away)}], widely=False)
    camera = found["camera"]
    assert found["poses"][0]["translation"] == pytest.approx(camera["translation"], abs=1e-6)
    x, y, z = found["poses"][1]["translation"]
    assert z == pytest.approx(1.5 * camera["translation"][2])
    assert camera["fx"] * x / z + camera["cx"] == pytest.approx(0.75)
    assert camera["fy"] * y / z + camera["cy"] == pytest.approx(0.25 / camera["aspect"])
    own, now = (np.array(each).reshape(3, 3) for each in (camera["rotation"], found["poses"][1]["rotation"]))
    turn = own.T @ now
    assert np.degrees(np.arctan2(-turn[2, 0], turn[2, 2])) == pytest.approx(found["orbit"]["yaw"][1] + 10, abs=0.1)


def test_a_mirror_changes_sides(trained: TrainedAvatar, tmp_path: Path) -> None:
    face: dict[str, Any] = {"scores": {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.1, "jawOpen": 0.2, "jawLeft": 0.3}}
    face["matrix"] = as_landmarker(place(trained, (0.2, 0.3, 0.0), (0.1, 0.05, 0.6)))
    found = driven(trained, tmp_path, faces=[face])
    mirrored, back = found["mirrored"][0], found["back"][0]
    assert mirrored["scores"] == {"mouthSmileRight": 0.7, "mouthSmileLeft": 0.1, "jawOpen": 0.2, "jawRight": 0.3}
    other = as_landmarker(place(trained, (0.2, -0.3, 0.0), (-0.1, 0.05, 0.6)))
    assert mirrored["matrix"] == pytest.approx(other, abs=1e-4)
    assert back == {"scores": face["scores"], "matrix": face["matrix"]}


def test_the_calm_face_is_what_the_face_comes_back_to(trained: TrainedAvatar, tmp_path: Path) -> None:
    """Somebody with an open mouth by nature speaks and blinks most of the time."""
    generator = np.random.default_rng(2)
    faces = []
    for k in range(20):
        jaw, blink = (0.2 + 0.01 * (k % 5), 0.1) if k % 4 == 0 else generator.uniform((0.3, 0.2), (0.9, 0.8))
        faces.append({"scores": {"jawOpen": jaw, "eyeBlinkLeft": blink}, "matrix": [k] * 16})
    calm = driven(trained, tmp_path, faces=faces)["calm"]
    assert calm["scores"] == {"jawOpen": pytest.approx(0.22), "eyeBlinkLeft": 0.1} and calm["matrix"] == [12] * 16


def test_smoothing_calms_a_still_face_and_keeps_up_with_a_quick_one(trained: TrainedAvatar, tmp_path: Path) -> None:
    noise = 0.3 + 0.01 * np.random.default_rng(1).standard_normal(200)
    still = np.array(driven(trained, tmp_path, values=noise.tolist())["smooth"])
    assert still[0] == noise[0] and abs(still[50:].mean() - 0.3) < 0.003
    assert np.diff(still[20:]).std() < 0.4 * np.diff(noise[20:]).std()
    blink = [0.0] * 10 + [1.0] * 4  # 160 ms
    assert driven(trained, tmp_path, values=blink)["smooth"][11] > 0.9, "within 40 ms of the picture that shows it"


def test_a_head_model_without_names_moves_jaw_lids_and_gaze(nameless: TrainedAvatar, tmp_path: Path) -> None:
    found = driven(nameless, tmp_path, faces=[{"scores": dict.fromkeys(NAMES, 0.5), "matrix": None}])
    moved = np.array(found["poses"][0]["parameters"]) - np.array(found["rest"])
    E = nameless.assets.num_expressions
    assert not moved[:E].any() and np.abs(moved[E : E + 6]).max() > 0.01 and moved[E + 18] == pytest.approx(0.5)
