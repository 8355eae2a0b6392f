"""The viewer as it runs: started by the command, reached over HTTP, driven in Chromium."""

from __future__ import annotations

import http.client
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browsers import chromium
from command_line import avatar
from lively import lively_avatar, lively_run
from waiting import until

from avatar.motion.orbit import orbited
from avatar.runs.clips import own_clip
from avatar.runs.trained import TrainedAvatar
from avatar.view.player import Player
from avatar.view.server import Viewer, padded
from avatar.view.stage import Look, Setting, Stage

pytest.importorskip("viser")
WIDTH = 96


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def viewer(trained: TrainedAvatar) -> Iterator[Viewer]:
    player = Player(trained, {"train": own_clip(trained, "train")}, time.monotonic)
    viewer = Viewer(Stage(trained), player, WIDTH, "127.0.0.1", 0, None)
    yield viewer
    viewer.close()


def shows(viewer: Viewer, setting: Setting) -> bool:
    shown = viewer.player.now()
    expected = viewer.stage.draw((shown.params, shown.camera), setting, WIDTH)
    return viewer.picture is not None and np.array_equal(viewer.picture, expected)


def test_what_is_set_is_drawn(viewer: Viewer) -> None:
    until(lambda: shows(viewer, Setting()))
    setting = Setting(Look(3.0), {0: viewer.stage.controls[0].high}, {"jaw": 0.2}, "mesh")
    viewer.change(**vars(setting))
    until(lambda: shows(viewer, setting))
    viewer.player.choose("train")
    viewer.player.play()
    seen: list[np.ndarray] = []
    until(
        lambda: len(seen) > 3 or (seen.append(viewer.picture) if not any(s is viewer.picture for s in seen) else None)
    )
    assert viewer.milliseconds > 0


def test_while_things_move_the_picture_is_as_small_as_it_must_be(viewer: Viewer) -> None:
    for _ in range(40):
        viewer._fit(100.0)
    assert viewer._moving_width == WIDTH, "never below the least, here the whole"
    viewer._width = 512
    for _ in range(40):
        viewer._fit(1.0)
    assert viewer._moving_width == 512
    viewer._fit(100.0)
    assert 400 < viewer._moving_width < 512
    before = viewer._moving_width
    viewer._fit(25.0)
    assert viewer._moving_width == before


def test_a_camera_of_the_page_is_a_turn_of_the_head(viewer: Viewer, trained: TrainedAvatar) -> None:
    camera = trained.rest_camera()
    position = (-camera.R_cam_world.T @ camera.t_cam_world).numpy()
    look = viewer.look_from(position)
    assert abs(look.yaw) < 1e-3 and abs(look.pitch) < 1e-3 and look.zoom == pytest.approx(1.0)
    turned = orbited(camera, 10.0, 5.0)
    position = (-turned.R_cam_world.T @ turned.t_cam_world).numpy() / 2
    look = viewer.look_from(position)
    assert (
        look.yaw == pytest.approx(10, abs=0.3)
        and look.pitch == pytest.approx(5, abs=0.3)
        and look.zoom == pytest.approx(2)
    )


def test_pictures_keep_their_shape() -> None:
    picture = np.zeros((10, 20, 3), np.uint8)
    assert padded(picture, 4.0, (1.0, 1.0, 1.0)).shape == (10, 40, 3)
    tall = padded(picture, 0.5, (1.0, 0.5, 0.0))
    assert tall.shape == (40, 20, 3) and (tall[15:25] == 0).all() and tall[0, 0].tolist() == [255, 128, 0]


@pytest.mark.chromium
def test_a_person_plays_and_moves_a_slider(viewer: Viewer) -> None:
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1000, "height": 700})
        page.goto(f"http://127.0.0.1:{viewer.port}/")
        page.get_by_role("button", name="Save picture").wait_for(timeout=30000)
        until(lambda: viewer._aspects)
        viewer.player.choose("train")
        page.get_by_role("button", name="Play", exact=True).click()
        until(lambda: viewer.player.is_playing)
        with page.expect_download() as download:
            page.get_by_role("button", name="Save picture").click()
        assert download.value.suggested_filename == "someone.png"
        page.get_by_role("slider").nth(1).focus()
        page.keyboard.press("ArrowRight")
        until(lambda: viewer._setting.expressions)


def test_the_command_serves_and_ends(tracked_folder: Path, tmp_path: Path) -> None:
    run = lively_run(tracked_folder, tmp_path / "run", "model.uv_size=8")
    words = ["view", str(run), "--port", "0", "--stream", "0", "--host", "0.0.0.0", "--size", "64"]
    process = subprocess.Popen(
        [sys.executable, "-m", "avatar.cli", *words],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells ignore it in what runs behind
    )
    try:
        assert process.stdout is not None
        said = ""
        while "Ctrl-C" not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
        found = re.search(r"http://0.0.0.0:(\d+)/\?token=(\S+)", said)
        assert found is not None and "Stream   127.0.0.1:" in said
        connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=10)
        connection.request("GET", "/")
        assert connection.getresponse().status == 401, "others need the token"
        connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=10)
        connection.request("GET", "/", headers={"Cookie": f"avatar_token={found[2]}"})
        response = connection.getresponse()
        assert response.status == 200 and b"<html" in response.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 130
    finally:
        process.kill()


def test_what_cannot_be_shown_is_said(tracked_folder: Path, tmp_path: Path) -> None:
    run = lively_run(tracked_folder, tmp_path / "run", "model.uv_size=8")
    assert "--size must be from" in avatar("view", run, "--size", 5, status=1)
    assert "--drive takes drive files" in avatar("view", run, "--drive", "x.mp4", "--port", 0, status=1)
    assert "gone.mp4 does not exist" in avatar("view", run, "--webcam", "gone.mp4", "--port", 0, status=1)
    assert "camera 97 gives no picture" in avatar("view", run, "--webcam", "97", "--port", 0, status=1)
    assert "not allowed with argument" in avatar("view", run, "--webcam", "--stream", 0, status=2)
    assert "--fov belongs to --webcam" in avatar("view", run, "--fov", 60, "--port", 0, status=1)
    assert "--token must be at least 8" in avatar("view", run, "--token", "short", status=1)
