"""The viewer as a person meets it: what is set is drawn, in a window of any shape; started and ended by the command."""

from __future__ import annotations

import http.client
import json
import socket
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("viser")
from browsers import chromium
from command_line import avatar
from lively import lively_avatar, lively_run
from view_client import TOKEN, WIDTH, Page, started
from waiting import until

from avatar.commands.view import address, checked_url, clips
from avatar.motion.orbit import orbited
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.player import Player
from avatar.view.view_renderer import Setting, ViewOffset, ViewRenderer
from avatar.view.viewer import LARGEST, Viewer, padded


def shows(viewer: Viewer, setting: Setting) -> bool:
    shown = viewer.player.now()
    expected = viewer.renderer.draw((shown.params, shown.camera), setting, WIDTH)
    return viewer.picture is not None and np.array_equal(viewer.picture, expected)


def page_of(viewer: Viewer) -> str:
    return f"http://127.0.0.1:{viewer.port}/?token={TOKEN}"


def test_what_is_set_is_drawn(viewer: Viewer) -> None:
    until(lambda: shows(viewer, Setting()))
    setting = Setting(ViewOffset(3.0), {0: viewer.renderer.controls[0].high}, {"jaw": 0.2}, "mesh")
    before = viewer._changed
    viewer.change(**vars(setting))
    assert viewer._changed > before, "pictures are small for a while"
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


def test_a_camera_of_the_page_is_a_turn_of_the_head(viewer: Viewer, shown_avatar: TrainedAvatar) -> None:
    camera = shown_avatar.rest_camera()
    position = (-camera.R_cam_world.T @ camera.t_cam_world).numpy()
    np.testing.assert_allclose(viewer.server.initial_camera.position, position, atol=1e-6)
    look = viewer.look_from(position)
    assert abs(look.yaw) < 1e-3 and abs(look.pitch) < 1e-3 and look.zoom == pytest.approx(1.0)
    turned = orbited(camera, 10.0, 5.0)
    position = (-turned.R_cam_world.T @ turned.t_cam_world).numpy() / 2
    look = viewer.look_from(position)
    assert (look.yaw, look.pitch) == pytest.approx((10, 5), abs=0.3) and look.zoom == pytest.approx(2)


def test_pictures_keep_their_shape() -> None:
    picture = np.zeros((10, 20, 3), np.uint8)
    assert padded(picture, 4.0, (1.0, 1.0, 1.0)).shape == (10, 40, 3)
    tall = padded(picture, 0.5, (1.0, 0.5, 0.0))
    square = padded(picture, 1.0, (1.0, 1.0, 1.0))
    assert (square[5:15] == 0).all() and (square[:5] == 255).all() and (square[15:] == 255).all()
    assert tall.shape == (40, 20, 3) and (tall[:10] == 0).all() and tall[10, 0].tolist() == [255, 128, 0]


@pytest.mark.parametrize("aspect", [1 / 16384, 10 / 900, 0.46, 1.0, 3000.0, 16384.0])
def test_what_is_sent_is_bounded_for_every_window(aspect: float) -> None:
    """The picture of --size 2048 with truth and error beside it."""
    picture = np.full((2048, 3 * 2048, 3), 255, np.uint8)
    sheet = padded(picture, aspect, (0.0, 0.0, 0.0))
    assert max(sheet.shape) <= LARGEST
    if 0.01 < aspect < 100:
        rows, columns = np.nonzero(sheet[..., 0] > 127)
        assert (np.ptp(columns) + 1) / (np.ptp(rows) + 1) == pytest.approx(3.0, rel=0.1)


def test_the_panel_has_no_empty_folder(viewer: Viewer) -> None:
    parts = {control.part for control in viewer.renderer.controls}
    assert len(parts) > 1
    with Page(f"http://127.0.0.1:{viewer.port}/{TOKEN}/") as page:
        page.until(lambda: "Reset face" in page.controls)
        assert sorted(page.folders) == sorted(["Motion", "Picture", "Joints", *parts])


def test_an_expression_that_training_hardly_shows_has_no_slider(shown_avatar: TrainedAvatar) -> None:
    """In fewer than a hundredth of the frames: its range is empty."""
    renderer = ViewRenderer(shown_avatar)
    first, *others = renderer.controls
    renderer.controls = [replace(first, low=0.0, high=0.0), *others]
    viewer = Viewer(renderer, Player(shown_avatar, {}, time.monotonic), 96, "127.0.0.1", 0, TOKEN)
    try:
        with Page(f"http://127.0.0.1:{viewer.port}/{TOKEN}/") as page:
            page.until(lambda: "Reset face" in page.controls)
            assert first.name not in page.controls and {control.name for control in others} <= set(page.controls)
    finally:
        viewer.close()


def test_the_panel_says_why_nothing_plays_and_there_is_no_truth(viewer: Viewer) -> None:
    with Page(f"http://127.0.0.1:{viewer.port}/{TOKEN}/") as page:
        page.set("Play", True)
        page.until(lambda: any("Choose a motion" in text for text in page.notifications))
        page.set("Truth beside", True)
        page.until(lambda: "No truth to show" in str(page.values))
        assert viewer.picture is not None and viewer.picture.shape == (WIDTH, WIDTH, 3)
        page.set("Motion", "train")
        page.until(lambda: viewer.picture is not None and viewer.picture.shape == (WIDTH, 2 * WIDTH, 3))
        page.values.clear()
        page.until(lambda: "pixels" in str(page.values))
        assert "No truth to show" not in str(page.values)


def test_controls_are_in_percent_and_seconds_and_still_pictures_lose_nothing(viewer: Viewer) -> None:
    with Page(f"http://127.0.0.1:{viewer.port}/{TOKEN}/") as page:
        page.until(lambda: page.format == "png")
        page.set("jaw open", 50)
        until(lambda: viewer.setting.joints)
        assert viewer.setting.joints["jaw"] == pytest.approx(0.5 * viewer.renderer.joints["jaw"][1])
        page.set("Motion", "train")
        until(lambda: viewer.player.duration)
        page.set("Play", True)
        page.until(lambda: page.format == "jpeg")
        page.set("Play", True)
        page.until(lambda: page.format == "png")
        page.set("Time, s", 0.2)
        until(lambda: viewer.player.seconds == pytest.approx(0.2))


@pytest.mark.chromium
def test_a_person_uses_every_control(viewer: Viewer) -> None:
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 640, "height": 400})
        page.goto(page_of(viewer))
        page.get_by_role("button", name="Save picture").wait_for(timeout=30000)
        for label, choice in (("Motion", "train"), ("Overlay", "mesh")):
            page.get_by_role("combobox", name=label).click()
            page.get_by_role("option", name=choice).click()
        page.get_by_role("checkbox", name="Truth beside").press(" ")
        until(lambda: viewer.setting.overlay == "mesh" and viewer.setting.with_truth)
        page.get_by_role("button", name="Play", exact=True).press("Enter")
        until(lambda: viewer.player.is_playing)
        page.get_by_role("button", name="Pause", exact=True).press("Enter")
        until(lambda: not viewer.player.is_playing)
        assert saved(page, "picture") == "someone.png"
        for closed in ("Brows", "Cheeks"):
            page.get_by_text(closed, exact=True).click()
        time, *sliders = page.get_by_role("slider").all()
        time.press("End")
        until(lambda: viewer.player.seconds > 0.9 * viewer.player.duration)
        for used, slider in enumerate(sliders, start=1):
            is_at_end = slider.get_attribute("aria-valuenow") == slider.get_attribute("aria-valuemax")
            slider.press("ArrowLeft" if is_at_end else "ArrowRight")
            until(lambda used=used: len(viewer.setting.expressions) + len(viewer.setting.joints) == used)
        page.get_by_role("button", name="Reset face").press("Enter")
        until(lambda: not viewer.setting.expressions and not viewer.setting.joints)
        until(lambda: not viewer._save_lock.locked())
        assert saved(page, "video") == "someone-train.mp4"
    assert not viewer.complaints._counts, "viser's own page sends nothing that is refused"


def saved(page: Any, what: str) -> str:
    """The name of the file."""
    with page.expect_download() as download:
        page.get_by_role("button", name=f"Save {what}").press("Enter")
    return download.value.suggested_filename


CANVAS = (
    "(() => { const c = window.__viserMutable?.canvas?.getBoundingClientRect();"
    " return c ? [c.width, c.height, c.right] : null })()"
)
SCHEME = "document.documentElement.dataset.mantineColorScheme"
IMAGE = (
    "(() => { const i = window.__viserMutable?.backgroundMaterial?.uniforms.colorMap.value?.image;"
    " return i ? i.width / i.height : 0 })()"
)


@pytest.mark.chromium
def test_the_panel_does_not_cover_the_picture_and_a_phone_does_not_stretch_it(viewer: Viewer) -> None:
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1000, "height": 700})
        page.goto(page_of(viewer))
        panel = page.get_by_role("button", name="Save picture")
        panel.wait_for(timeout=30000)
        until_shaped(page)
        assert page.evaluate(CANVAS)[2] <= panel.bounding_box()["x"], "the picture ends where the panel begins"
        assert page.title() == "someone - avatar" and page.evaluate(SCHEME) == "light"
        small = {"width": 390, "height": 844}
        phone = browser.new_page(viewport=small, is_mobile=True, has_touch=True, color_scheme="dark")
        phone.goto(page_of(viewer))
        until_shaped(phone)
        assert phone.evaluate(SCHEME) == "dark"
        phone.set_viewport_size({"width": 844, "height": 390})
        until_shaped(phone)


def until_shaped(page: Any) -> None:
    """The picture that the page shows has the shape of its window."""

    def is_shaped() -> bool:
        window, shown = page.evaluate(CANVAS), page.evaluate(IMAGE)
        page.wait_for_timeout(50)
        return bool(window and shown) and shown == pytest.approx(window[0] / window[1], rel=0.02)

    until(is_shaped)


@pytest.mark.slow
def test_the_command_serves_and_ends(tracked_folder: Path, tmp_path: Path) -> None:
    run = lively_run(tracked_folder, tmp_path / "run", "model.uv_size=8")
    with started(run, "--stream", 0, "--host", "0.0.0.0", "--size", 64) as viewer:
        assert "0.0.0.0" not in viewer.said, "no other machine can open that"
        assert len(viewer.token) >= 16 and json.dumps({"token": viewer.token}) in viewer.said
        for path, status in (("/", 401), (f"/{viewer.token}/", 200)):
            connection = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=10)
            connection.request("GET", path)
            assert connection.getresponse().status == status
        assert viewer.listening() == {viewer.port, viewer.stream}, "and nothing else"
        with Page(viewer.page) as page:
            page.next_picture()
            page.send(b"\xc1")
            socket.create_connection(("127.0.0.1", viewer.port))
            assert viewer.interrupt() < 10


def test_addresses_can_be_opened() -> None:
    assert address("127.0.0.1", 80) == address("localhost", 80) == "http://127.0.0.1:80/"
    assert address("::1", 80) == "http://[::1]:80/" and address("fe80::1", 80) == "http://[fe80::1]:80/"
    assert address("box.example.org", 8080) == "http://box.example.org:8080/"
    assert (
        address("127.0.0.1", 80, checked_url("https://hub.example.org/proxy/80")) == "https://hub.example.org/proxy/80/"
    )
    for everywhere in ("0.0.0.0", "::"):
        assert "0.0.0.0" not in address(everywhere, 80) and "[::]" not in address(everywhere, 80)


def test_what_cannot_be_shown_is_said(tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = lively_run(tracked_folder, tmp_path / "run", "model.uv_size=8")
    assert "--size must be from" in avatar("view", run, "--size", 5, status=1)
    assert "--drive takes drive files" in avatar("view", run, "--drive", "x.mp4", "--port", 0, status=1)
    assert "gone.mp4 does not exist" in avatar("view", run, "--webcam", "gone.mp4", "--port", 0, status=1)
    assert "camera 97 gives no picture" in avatar("view", run, "--webcam", "97", "--port", 0, status=1)
    assert "not allowed with argument" in avatar("view", run, "--webcam", "--stream", 0, status=2)
    assert "--fov belongs to --webcam" in avatar("view", run, "--fov", 60, "--port", 0, status=1)
    assert "--open-stream belongs to --stream" in avatar("view", run, "--open-stream", "--port", 0, status=1)
    assert "must be at least 8" in avatar("view", run, "--token", "short", status=1)
    for wrong in ("hub.example.org", "ftp://x/", "https://", "https://[::1", "https://x/?a=b"):
        assert "--url takes the address" in avatar("view", run, "--url", wrong, status=1)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert "the viewer cannot listen on 127.0.0.1" in avatar("view", run, "--port", port, status=1)
    assert "cannot listen" in avatar("view", run, "--port", 70000, status=1)
    assert "cannot listen" in avatar("view", run, "--host", "no such host", status=1)
    monkeypatch.setenv("AVATAR_TOKEN", "not one!")
    assert "must be at least 8" in avatar("view", run, status=1)


def test_drive_files_of_one_name_are_both_there(tracked_folder: Path, tmp_path: Path, monkeypatch: Any) -> None:
    trained = lively_avatar(tracked_folder, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    Path("still").mkdir()
    paths = [Path("still/x.npz"), Path("x.npz")]
    for moves, path in enumerate(paths):
        expression = np.zeros((2, trained.assets.num_expressions), np.float32)
        expression[1] = moves
        np.savez(path, expression=expression)
    found = clips(trained, paths)
    names = ["x.npz", str(tmp_path / "x.npz")]
    assert list(found)[-2:] == names
    still, moving = ([params.expression for params, _ in found[name].frames] for name in names)
    assert torch.equal(still[0], still[1]) and not torch.equal(moving[0], moving[1])
