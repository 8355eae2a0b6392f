"""A face in front of a camera as the avatar's: relative to both neutral faces, and said when it cannot be followed."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from lively import lively_run
from waiting import until

from avatar.errors import UserError
from avatar.head.model import matrix_from_6d
from avatar.runs.trained_avatar import TrainedAvatar, load_avatar
from avatar.types import HeadParams
from avatar.view.live import LiveFrame, LiveTiming
from avatar.view.player import WEBCAM, Player
from avatar.view.webcam import Webcam, moved_camera
from data_prep.live.face_tracker import NO_FACE


@dataclass(frozen=True)
class Seen:
    params: HeadParams
    R_cam_head: torch.Tensor
    t_cam_head: torch.Tensor
    taken: float = 1.0


@dataclass(frozen=True)
class Calibrated:
    identity: torch.Tensor
    faces: list[Seen]


@dataclass
class Script:
    """A tracker that finds what the test puts in; an error is raised."""

    calibration: Calibrated | Exception
    found: queue.Queue[Seen | Exception | None] = field(default_factory=queue.Queue)
    milliseconds: dict[str, float] = field(default_factory=lambda: {"landmarks": 9.4, "fit": 12.0})

    def calibrate(self, say: Callable[[str], object]) -> Calibrated:
        say("Look into the camera.")
        if isinstance(self.calibration, Exception):
            raise self.calibration
        return self.calibration

    def follow(self) -> Seen | None:
        found = self.found.get(timeout=10)
        if isinstance(found, Exception):
            raise found
        return found

    def dropped(self) -> tuple[int, int]:
        return 3, 40

    def close(self) -> None:
        self.found.put(UserError("closed"))


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    run = lively_run(tracked_folder, tmp_path_factory.mktemp("runs") / "run", "model.uv_size=8")
    return load_avatar(run, tracked_folder / "head_model")


REST_R = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


@pytest.fixture
def rest(trained: TrainedAvatar) -> Seen:
    """The driver's neutral face, which is not the avatar's."""
    params = trained.rest_params()
    offset = torch.linspace(-0.02, 0.02, len(params.expression))
    return Seen(replace(params, expression=offset), REST_R, torch.tensor([0.02, -0.01, 0.6]))


@pytest.fixture
def script(rest: Seen) -> Script:
    return Script(Calibrated(torch.zeros(300), [rest] * 10))


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def webcam(trained: TrainedAvatar, script: Script, said: list[str]) -> Iterator[Webcam]:
    webcam = Webcam(trained, script, said.append)
    yield webcam
    webcam.close()


def shown(webcam: Webcam) -> LiveFrame:
    newest = webcam.newest()
    assert newest is not None
    return newest


def test_expressions_depart_from_both_neutral_faces(
    webcam: Webcam, script: Script, said: list[str], trained: TrainedAvatar, rest: Seen
) -> None:
    awake: list[int] = []
    webcam.start(lambda: awake.append(shown(webcam).number))
    until(lambda: said == ["Look into the camera.", "Calibrated: the avatar follows."])
    assert webcam.newest() is None
    script.found.put(rest)
    until(lambda: awake == [0])
    torch.testing.assert_close(shown(webcam).params.expression, trained.neutral.expression, atol=1e-6, rtol=0)
    torch.testing.assert_close(matrix_from_6d(shown(webcam).params.jaw), trained.neutral.jaw, atol=1e-5, rtol=0)
    smile = rest.params.expression.clone()
    smile[1] += 0.4
    lids = torch.tensor([0.7, 0.1])
    script.found.put(replace(rest, params=replace(rest.params, expression=smile, eyelids=lids), taken=2.5))
    until(lambda: awake == [0, 1])
    expected = trained.neutral.expression.clone()
    expected[1] += 0.4
    torch.testing.assert_close(shown(webcam).params.expression, expected, atol=1e-6, rtol=0)
    assert shown(webcam).params.eyelids.equal(lids) and shown(webcam).taken == 2.5
    assert webcam.status() == "Webcam: landmarks 9 ms, fit 12 ms; 3 of 40 pictures dropped"


def test_this_face_can_be_made_the_neutral_one(
    webcam: Webcam, script: Script, trained: TrainedAvatar, rest: Seen
) -> None:
    webcam.calibrate()  # nothing to take yet
    webcam.start(lambda: None)
    smile = replace(rest, params=replace(rest.params, expression=rest.params.expression + 0.3))
    script.found.put(smile)
    until(lambda: webcam.newest() is not None)
    assert (shown(webcam).params.expression - trained.neutral.expression).abs().min() > 0.29
    webcam.calibrate()
    script.found.put(replace(smile, t_cam_head=smile.t_cam_head + 0))
    until(lambda: shown(webcam).number == 1)
    torch.testing.assert_close(shown(webcam).params.expression, trained.neutral.expression, atol=1e-6, rtol=0)


def test_the_head_moves_as_the_drivers(trained: TrainedAvatar, rest: Seen) -> None:
    own = trained.rest_camera()
    assert torch.allclose(moved_camera(own, rest, rest).R_cam_world, own.R_cam_world, atol=1e-6)
    turn = axis_angle_to_rotation_matrix(torch.tensor([[0.0, 0.3, 0.0]]))[0]
    moved = replace(rest, R_cam_head=turn @ rest.R_cam_head, t_cam_head=rest.t_cam_head + torch.tensor([0.06, 0, 0]))
    camera = moved_camera(own, rest, moved)
    torch.testing.assert_close(camera.R_cam_world @ own.R_cam_world.T, turn, atol=1e-5, rtol=0)
    assert camera.fx == own.fx and camera.t_cam_world[1:].equal(own.t_cam_world[1:])
    share = (camera.t_cam_world[0] - own.t_cam_world[0]) / own.t_cam_world[2]
    assert float(share) == pytest.approx(0.06 / 0.6), "as far across the picture, whatever the distance"


@pytest.mark.parametrize("joint", ["jaw", "turn", "lean"])
def test_a_torso_that_training_moved_stays_while_the_head_turns(
    joint: str, trained: TrainedAvatar, script: Script, rest: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("avatar.view.webcam.joint_ranges", lambda _: {joint: (-1.0, 1.0)})
    webcam: Any = Webcam(trained, script, lambda _: None)  # type: ignore[arg-type]
    webcam._learn(script.calibration)
    turn = axis_angle_to_rotation_matrix(torch.tensor([[0.0, 0.4, 0.0]]))[0]
    webcam._take(replace(rest, R_cam_head=turn @ rest.R_cam_head))
    own, neck = trained.rest_camera().R_cam_world, matrix_from_6d(trained.rest_params().neck)
    expected = neck if joint == "jaw" else neck @ own.T @ turn @ own
    torch.testing.assert_close(matrix_from_6d(shown(webcam).params.neck), expected, atol=1e-5, rtol=0)


def test_without_a_face_the_last_one_stays(webcam: Webcam, script: Script, rest: Seen) -> None:
    webcam.start(lambda: None)
    script.found.put(rest)
    script.found.put(None)
    until(lambda: webcam.status() == NO_FACE)
    assert shown(webcam).number == 0
    script.found.put(rest)
    until(lambda: shown(webcam).number == 1)
    assert webcam.status() != NO_FACE


def test_the_end_is_said_once_and_the_face_stays(webcam: Webcam, script: Script, rest: Seen, said: list[str]) -> None:
    webcam.start(lambda: None)
    script.found.put(rest)
    script.found.put(UserError("camera 0 gives no pictures any more"))
    until(lambda: not webcam._thread.is_alive())
    assert webcam.status() == said[-1] == "camera 0 gives no pictures any more"
    assert shown(webcam).number == 0 and said.count(said[-1]) == 1


def test_calibration_that_fails_is_said(trained: TrainedAvatar, said: list[str]) -> None:
    webcam = Webcam(trained, Script(UserError("x.mp4 has ended")), said.append)
    webcam.start(lambda: None)
    until(lambda: not webcam._thread.is_alive())
    assert said[-1] == webcam.status() == "x.mp4 has ended" and webcam.newest() is None


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_what_nobody_foresaw_is_said_too(trained: TrainedAvatar, said: list[str]) -> None:
    webcam = Webcam(trained, Script(ZeroDivisionError("by zero")), said.append)
    webcam.start(lambda: None)
    until(lambda: not webcam._thread.is_alive())
    assert "has failed (ZeroDivisionError: by zero)" in webcam.status()


def test_closing_ends_at_once_and_says_nothing(webcam: Webcam, said: list[str]) -> None:
    webcam.start(lambda: None)
    until(lambda: len(said) == 2)
    begin = time.monotonic()
    webcam.close()
    assert time.monotonic() - begin < 2 and len(said) == 2


def test_the_player_shows_it_with_the_heads_pose(trained: TrainedAvatar) -> None:
    frame = LiveFrame(4, trained.rest_params(), replace(trained.rest_camera(), cx=7.0), 3.5)
    player = Player(trained, {}, lambda: 0.0, lambda: frame, WEBCAM)
    assert player.name == WEBCAM and player.names[-1] == WEBCAM
    now = player.now()
    assert now.params is frame.params and now.camera.cx == 7.0 and now.taken == 3.5 and now.key == (WEBCAM, 4)
    player.choose("neutral face")
    assert player.now().taken is None


def test_pace_is_of_the_last_seconds() -> None:
    timing = LiveTiming()
    assert timing.now(0.0) is None
    for n in range(11):
        timing.add(n / 10, n / 10 + 0.05)
        timing.add(n / 10, n / 10 + 0.09)  # drawn again, larger
    latency, rate = timing.now(1.2)  # type: ignore[misc]
    assert latency == pytest.approx(50) and rate == pytest.approx(10)
    assert timing.now(10.0) is None
