"""What the viewer draws for what is set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lively import lively_avatar

from avatar.data.camera_rig import CameraRig, RigCamera
from avatar.motion.controls import joint_values, posed
from avatar.motion.orbit import orbited
from avatar.runs.motion_clip import own_clip
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.tensors import to_8_bit
from avatar.types import Camera
from avatar.view.live import LiveFrame
from avatar.view.player import NEUTRAL, STREAM, Player
from avatar.view.view_renderer import MARGIN, Setting, ViewOffset, ViewRenderer, _draw_mesh

WIDTH = 64


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def renderer(trained: TrainedAvatar) -> ViewRenderer:
    return ViewRenderer(trained, lambda index, width: torch.full((width, width, 3), index / 100))


def test_a_frame_is_drawn_as_the_program_draws_it(renderer: ViewRenderer, trained: TrainedAvatar) -> None:
    params, camera = trained.recording.params(5), trained.recording.camera(5, 48)
    look = ViewOffset(renderer.limits.yaw[1], renderer.limits.pitch[0], 1.5)
    drawn = renderer.draw((params, camera), Setting(look), WIDTH, 5)
    expected = trained.render(params, orbited(camera.resized(WIDTH, WIDTH), look.yaw, look.pitch, look.zoom)).image
    np.testing.assert_array_equal(drawn, to_8_bit(expected).numpy())
    assert not np.array_equal(drawn, renderer.draw((params, camera), Setting(), WIDTH))


def test_the_mesh_lies_on_the_pixels_that_it_is_projected_to() -> None:
    vertices = torch.tensor([[2.5, 4.5, 1.0], [12.5, 4.5, 1.0], [7.5, 12.5, 1.0]])
    camera = Camera(torch.eye(3), torch.zeros(3), 1.0, 1.0, 0.0, 0.0, 16, 16)  # pixels for metres
    picture = np.zeros((16, 16, 3), np.uint8)
    _draw_mesh(picture, vertices, torch.tensor([[0, 1, 2]]), camera)
    above, on, below = picture[3:6, 7, 1].tolist()
    assert abs(above - below) < 10 and on > 2 * max(above, below), "an edge through the centres of a row"


def test_controls_add_and_joints_replace(renderer: ViewRenderer, trained: TrainedAvatar) -> None:
    frame = trained.recording.params(9)
    moved = renderer.params(frame, Setting(expressions={0: 0.5, 1: -0.25}, joints={"jaw": 0.2, "left_lid": 0.7}))
    expected = frame.expression + 0.5 * renderer.controls[0].direction - 0.25 * renderer.controls[1].direction
    torch.testing.assert_close(moved.expression, expected)
    torch.testing.assert_close(moved.jaw, posed(frame, None, {"jaw": 0.2}).jaw)
    assert moved.eyelids[0] == 0.7 and moved.eyelids[1] == frame.eyelids[1]
    assert torch.equal(moved.eyes, frame.eyes) and torch.equal(moved.neck, frame.neck)
    assert renderer.params(frame, Setting(joints={"jaw": 0.0})).jaw.equal(frame.jaw)


def test_one_axis_of_a_joint_leaves_the_other_to_the_motion(renderer: ViewRenderer, trained: TrainedAvatar) -> None:
    frame = posed(trained.recording.params(9), None, {"look_down": 0.1, "look_left": -0.2, "lean": 0.05, "turn": 0.1})
    moved = joint_values([renderer.params(frame, Setting(joints={"look_left": 0.15, "lean": -0.1}))])
    found = {name: round(float(moved[name]), 2) for name in ("look_down", "look_left", "lean", "turn")}
    assert found == {"look_down": 0.1, "look_left": 0.15, "lean": -0.1, "turn": 0.1}


def test_the_camera_stays_where_the_avatar_is_known(renderer: ViewRenderer) -> None:
    kept, is_supported = renderer.within(ViewOffset(500.0, -500.0, 100.0))
    assert (
        kept == ViewOffset(renderer.limits.yaw[1] + MARGIN, renderer.limits.pitch[0] - MARGIN, 4.0) and not is_supported
    )
    assert renderer.within(ViewOffset()) == (ViewOffset(), True)


def test_overlays(renderer: ViewRenderer, trained: TrainedAvatar) -> None:
    frame = trained.recording.params(5), trained.recording.camera(5, WIDTH)
    plain = renderer.draw(frame, Setting(), WIDTH, 5)
    mesh = renderer.draw(frame, Setting(overlay="mesh"), WIDTH, 5)
    changed = (mesh != plain).any(axis=2)
    assert 0.02 < changed.mean() < 0.9
    both = renderer.draw(frame, Setting(overlay="error", with_truth=True), WIDTH, 5)
    assert both.shape == (WIDTH, 3 * WIDTH, 3)
    assert (both[:, WIDTH : 2 * WIDTH] == round(255 * 0.05)).all(), "the truth of frame 5"
    turned = renderer.draw(frame, Setting(ViewOffset(5.0), overlay="error"), WIDTH, 5)
    np.testing.assert_array_equal(turned[:, WIDTH:], both[:, 2 * WIDTH :], "the error is of the recorded view")
    assert renderer.draw(frame, Setting(overlay="error", with_truth=True), WIDTH).shape == plain.shape, (
        "no truth of other motion"
    )


def test_beside_a_truth_the_avatar_is_seen_by_the_camera_that_filmed_it(trained: TrainedAvatar) -> None:
    """The second camera, whose pictures are flatter, lacks time 2; a film stays of one size all the same."""
    own = trained.recording
    lenses = [
        RigCamera(name, own.width, height, own.intrinsics) for name, height in (("a", own.width), ("b", own.width // 2))
    ]
    views = tuple(int(time != 2) for time in range(len(own)))
    recording = replace(own, rig=CameraRig(tuple(lenses), tuple(range(len(own))), views))
    filmed = replace(trained, recording=recording)
    renderer = ViewRenderer(filmed, lambda i, width: torch.zeros(recording.image_size(width, i)[1], width, 3))
    clip = own_clip(filmed, "train")
    drawn = renderer.draw(clip.frames[2], Setting(with_truth=True), WIDTH, 2)
    expected = filmed.render(recording.params(2), recording.camera(2, WIDTH)).image
    np.testing.assert_array_equal(drawn[:, :WIDTH], to_8_bit(expected).numpy())
    short = replace(clip, frames=clip.frames[:4], recorded=(0, 1, 2, 3))
    assert {picture.shape for picture in renderer.film(short, Setting(), WIDTH)} == {(WIDTH // 2, WIDTH, 3)}
    beside = list(renderer.film(short, Setting(with_truth=True), WIDTH))
    assert {picture.shape for picture in beside} == {(WIDTH // 2, 2 * WIDTH, 3)}
    np.testing.assert_array_equal(beside[1], renderer.draw(clip.frames[1], Setting(with_truth=True), WIDTH, 1))


def test_overlays_that_an_avatar_does_not_have(trained: TrainedAvatar, renderer: ViewRenderer) -> None:
    assert renderer.overlays == ("none", "mesh", "error")
    assert ViewRenderer(trained).overlays == ("none", "mesh")


def test_the_distance_is_that_of_the_motion_statistics(renderer: ViewRenderer, trained: TrainedAvatar) -> None:
    rest = trained.rest_params()
    far = replace(rest, expression=rest.expression + 20)
    own = trained.statistics.expressions.distances([trained.recording.params(3)])
    assert renderer.distance(trained.recording.params(3)) == float(own[0])
    assert renderer.distance(far) > 2 * renderer.distance(rest)


def test_a_motion_plays_pauses_and_is_scrubbed(trained: TrainedAvatar) -> None:
    now = [100.0]
    clip = own_clip(trained, "train")
    player = Player(trained, {"train": clip}, lambda: now[0])
    assert player.names == (NEUTRAL, "train") and player.now().recorded is None
    player.play()
    assert not player.is_playing, "a face at rest does not play"
    player.choose("train")
    player.play()
    now[0] += 3.5 / clip.fps
    assert player.index == 3 and player.now().recorded == clip.recorded[3] and player.now().params is clip.frames[3][0]
    player.pause()
    now[0] += 10
    assert player.index == 3
    player.seek(4.2 / clip.fps)
    assert player.index == 4 and player.seconds == 4 / clip.fps
    player.seek(1e3)
    assert player.index == len(clip) - 1 and player.seconds == player.duration
    player.play()
    now[0] += 1.5 / clip.fps
    assert player.index == 0, "it starts again after its end"
    with pytest.raises(ValueError, match="there is no motion 'dance'"):
        player.choose("dance")


def test_a_stream_is_shown_from_its_first_frame_on(trained: TrainedAvatar) -> None:
    newest: list = [None]
    player = Player(trained, {}, lambda: 0.0, lambda: newest[0])
    assert player.name == STREAM and player.now().params.expression.equal(trained.rest_params().expression)
    newest[0] = LiveFrame(7, trained.recording.params(3))
    shown = player.now()
    assert shown.params is newest[0].params and shown.key == (STREAM, 7) and shown.recorded is None
