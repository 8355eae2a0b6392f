"""Pictures by the names of what moves, and as files."""

from __future__ import annotations

import io
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from lively import lively_avatar

from avatar.errors import UserError
from avatar.motion.controls import posed
from avatar.motion.orbit import orbited
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Rendering


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run", "model.uv_size=16")


def test_a_pose_is_named(trained: TrainedAvatar) -> None:
    rest = trained.rest_params()
    control = trained.expression_controls()[0]
    name = control.name.replace(" ", "_")
    picture = trained.pose(**{name: 0.5}, jaw=0.2, left_lid=1, yaw=8, pitch=-3, zoom=1.2, size=32)
    expected = posed(rest, {control: 0.5}, {"jaw": 0.2, "left_lid": 1.0})
    truth = trained.render(expected, orbited(trained.rest_camera(32), 8, -3, 1.2))
    assert torch.equal(picture.image, truth.image) and picture.image.shape == (32, 32, 3)
    both = f"{control.part}_{control.name}".replace(" ", "_")
    assert torch.equal(trained.pose(**{both: 0.5}).image, trained.pose(**{name: 0.5}).image)
    turned = trained.render(posed(rest, None, {"lean": 0.2, "turn": -0.3}))
    assert torch.equal(trained.pose(lean=0.2, turn=-0.3).image, turned.image)
    assert not torch.equal(turned.image, trained.render(rest).image)
    assert torch.equal(trained.pose().image, trained.render(rest).image)
    closed = trained.render(posed(rest, None, {"left_lid": 1.0, "right_lid": 1.0}))
    assert torch.equal(trained.pose(left_lid=1, right_lid=1).image, closed.image)
    with pytest.raises(UserError, match=f"this avatar has no ears; it has jaw, look_down.*{name}"):
        trained.pose(ears=1)


def test_pictures_as_bytes(trained: TrainedAvatar) -> None:
    rendering = trained.render(trained.rest_params())
    values = rendering.numpy()
    assert values.dtype == np.uint8
    assert np.abs(values / 255 - rendering.image.clamp(0, 1).detach().numpy()).max() < 0.003
    data = rendering.png()
    assert data == rendering._repr_png_() == trained._repr_png_()
    assert np.array_equal(iio.imread(io.BytesIO(data)), values)
    with pytest.raises(ValueError, match="5 features are no picture"):
        Rendering(torch.zeros(4, 4, 5), torch.zeros(4, 4)).png()
