"""What a Python program gives a trained avatar: a wrong frame or camera ends in a sentence that names it."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import train_small

import avatar
from avatar.errors import UserError
from avatar.runs.trained_avatar import TrainedAvatar


@pytest.fixture(scope="module")
def anna(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    run = tmp_path_factory.mktemp("runs") / "run"
    train_small(tracked_folder, run, ["trainer.iterations=1"])
    return avatar.load(run)


NAN, INF = float("nan"), float("inf")
FRAMES = {
    "a number": (lambda _: 250, r"avatar\.types\.HeadParams.*not as int"),
    "nothing": (lambda _: None, r"avatar\.types\.HeadParams.*not as NoneType"),
    "coefficients alone": (lambda p: p.expression, r"avatar\.types\.HeadParams.*not as torch\.float32"),
    "NaN": (lambda p: replace(p, expression=p.expression * NAN), r"params\.expression .*nan"),
    "infinity": (lambda p: replace(p, jaw=p.jaw + INF), r"params\.jaw .*inf"),
    "float64": (lambda p: replace(p, eyes=p.eyes.double()), r"params\.eyes is torch\.float64.*params\.eyes\.float\(\)"),
    "all float64": (
        lambda p: type(p)(**{field.name: getattr(p, field.name).double() for field in fields(p)}),
        r"params\.expression is torch\.float64",
    ),
    "whole numbers": (lambda p: replace(p, eyelids=torch.zeros(2, dtype=torch.int64)), r"params\.eyelids .*int64"),
    "numpy": (lambda p: replace(p, neck=p.neck.numpy()), r"params\.neck must be a torch\.Tensor.*ndarray"),
    "a list": (lambda p: replace(p, eyelids=[0, 0]), r"params\.eyelids must be a torch\.Tensor.*list"),
    "a short expression": (lambda p: replace(p, expression=p.expression[:3]), r"expression has 3 .* the 10 of"),
    "an empty expression": (lambda p: replace(p, expression=p.expression[:0]), r"expression has 0 .* the 10 of"),
    "a long expression": (lambda p: replace(p, expression=torch.zeros(11)), r"expression has 11 .* the 10 of"),
    "a batch": (lambda p: replace(p, expression=p.expression[None]), r"params\.expression must have shape \[E\]"),
    "a rotation vector": (lambda p: replace(p, jaw=torch.zeros(3)), r"params\.jaw must have shape \[6\], got \[3\]"),
}


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize("name", FRAMES)
def test_a_wrong_frame_is_named_and_the_training_is_not_blamed(name: str, anna: TrainedAvatar) -> None:
    make, sentence = FRAMES[name]
    frame: Any = make(anna.rest_params())
    for draw in (anna.render, anna.gaussians, lambda given: list(anna.stream([given]))):
        with pytest.raises(UserError, match=sentence) as error:
            draw(frame)
        assert "training" not in str(error.value) and "\n" not in str(error.value)


CAMERAS = {
    "a number": (lambda _: 250, r"avatar\.types\.Camera.*not as int"),
    "float64": (lambda c: replace(c, R_cam_world=c.R_cam_world.double()), r"camera\.R_cam_world is torch\.float64"),
    "NaN": (lambda c: replace(c, t_cam_world=c.t_cam_world * NAN), r"camera\.t_cam_world .*nan"),
    "4x4": (lambda c: replace(c, R_cam_world=torch.eye(4)), r"camera\.R_cam_world must have shape \[3, 3\]"),
}


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize("name", CAMERAS)
def test_a_wrong_camera_is_named(name: str, anna: TrainedAvatar) -> None:
    make, sentence = CAMERAS[name]
    camera: Any = make(anna.rest_camera())
    for draw in (anna.render, anna.gaussians, lambda frame, view: list(anna.stream([(frame, view)]))):
        with pytest.raises(UserError, match=sentence):
            draw(anna.rest_params(), camera)


def test_a_stream_of_something_else_is_refused(anna: TrainedAvatar) -> None:
    wrong: Any
    for wrong in (250, anna.rest_params()):
        with pytest.raises(UserError, match="a stream takes frames one after another"):
            anna.stream(wrong)
    for wrong in ([250], [(anna.rest_params(), anna.rest_camera(), 1)]):
        with pytest.raises(UserError, match="HeadParams"):
            list(anna.stream(wrong))


def test_the_cameras_width_is_a_whole_number_of_pixels(anna: TrainedAvatar) -> None:
    for size in (0, -1, 1.5):
        with pytest.raises(UserError, match=f"size is {size}: give a whole number of pixels"):
            anna.rest_camera(size)  # type: ignore[arg-type]
    assert anna.rest_camera(64).width == 64


@pytest.mark.parametrize(
    "wrong",
    [
        {"size": 0},
        {"zoom": 0},
        {"zoom": -1.0},
        {"zoom": NAN},
        {"yaw": INF},
        {"pitch": "up"},
        {"jaw": None},
        {"jaw": "0.2"},
        {"left_lid": np.array([0.2])},
    ],
)
def test_a_pose_that_is_no_picture_names_the_value(wrong: dict[str, Any], anna: TrainedAvatar) -> None:
    with pytest.raises(UserError, match=f"^{next(iter(wrong))} is "):
        anna.pose(**wrong)


def test_a_pose_takes_the_numbers_of_numpy(anna: TrainedAvatar) -> None:
    ours = anna.pose(yaw=5, pitch=2.5, zoom=1.5, size=32)
    theirs = anna.pose(yaw=np.int64(5), pitch=np.float32(2.5), zoom=np.float64(1.5), size=np.int64(32))  # type: ignore[arg-type]
    assert torch.equal(ours.image, theirs.image)


def test_a_joint_that_moves_no_vertex_is_no_pose(anna: TrainedAvatar) -> None:
    assets = anna.assets
    weights = assets.weights.clone()
    weights[:, 0] += weights[:, 2]
    weights[:, 2] = 0.0
    fixed = replace(assets, weights=weights, pose_dirs=torch.zeros_like(assets.pose_dirs))
    anna.pose(jaw=0.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(anna.avatar.head, "assets", fixed)
        with pytest.raises(UserError, match="this avatar has no jaw; it has look_down"):
            anna.pose(jaw=0.1)


def test_an_avatar_is_shown_in_one_line(anna: TrainedAvatar) -> None:
    assert re.fullmatch(r"<avatar of someone: [0-9,]+ Gaussians \(hypergaussians\), .* 24 frames, .*>", repr(anna))
    assert all(len(repr(part)) < 300 for part in (anna, anna.recording, anna.statistics, anna.assets))
