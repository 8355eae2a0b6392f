"""What a page does after a picture could not be drawn, and where a browser gives less than was asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from camera_rig_folder import write_single
from lively import enlivened, psnr
from pages import shown, until
from small_runs import SMALL

from avatar.cli import main
from avatar.export.default_view import front_camera, with_faded_neck
from avatar.export.web_page import write_page
from avatar.motion.orbit import orbited
from avatar.pipeline.open_inputs import open_run

SENT = """() => {
  window.sent = [];
  avatar.addEventListener("drawn", () => sent.push([avatar.canvas.width, avatar.canvas.height]));
}"""


@pytest.mark.chromium
def test_a_view_that_cannot_be_drawn_is_said_and_the_next_one_is_drawn(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    aspect = page.evaluate("avatar.header.camera.aspect")
    page.evaluate("avatar.header.camera.aspect = 1e-9")
    until(page, "!document.getElementById('message').hidden && !avatar.isBusy")
    refused = page.evaluate("avatar.screenshot(64).catch((error) => error.message)")
    assert refused == page.locator("#message").inner_text() == "This view cannot be drawn."
    page.evaluate(SENT)
    page.evaluate(f"avatar.header.camera.aspect = {aspect}")
    until(page, "sent.length > 0 && document.getElementById('message').hidden")


@pytest.mark.chromium
def test_an_upright_picture_is_drawn_as_large_as_it_can_be(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    page.evaluate("avatar.header.camera.aspect = 9 / 16")
    page.evaluate(SENT)
    page.evaluate("avatar.resize(64, 4000)")
    until(page, "sent.length > 0 && sent.at(-1)[0] === 2304 && sent.at(-1)[1] === 4096")
    assert page.locator("#message").is_hidden()


@pytest.mark.chromium
def test_a_context_that_the_browser_took_is_drawn_in_again(visit: Any) -> None:
    page = visit("&renderer=webgl", reduced_motion="reduce")
    page.evaluate("avatar.background = [0.2, 0.4, 0.6]")
    until(page, "!avatar.isBusy")
    page.wait_for_timeout(500)
    before = shown(page)
    page.evaluate("window.kept = avatar.canvas.getContext('webgl2').getExtension('WEBGL_lose_context')")
    page.evaluate("kept.loseContext()")
    page.wait_for_timeout(200)
    assert not shown(page).equal(before)
    page.evaluate("kept.restoreContext()")
    page.wait_for_timeout(500)
    assert shown(page).equal(before)


@pytest.mark.chromium
def test_a_camera_of_several_moves_around_a_head_that_stays(
    browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The head's rotation is an input of the network: here a strong one."""
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    folder = write_single(tmp_path)
    words = ["train", str(folder), "--out", str(tmp_path / "run"), "--head", str(tmp_path / "head_model")]
    assert main([*words, *SMALL, "trainer.perceptual=dssim", "model.head_rotation=true", "data.size=48"]) == 0
    trained = enlivened(open_run(tmp_path / "run", say=lambda _: None).trained)
    for parameter in trained.avatar.deformation.parameters():
        parameter.data *= 3.0
    page = browser.new_page(reduced_motion="reduce")
    page.goto(f"{write_page(trained, tmp_path / 'rig.html', 'float').path.as_uri()}?width=64")
    page.locator("#message").wait_for(state="hidden", timeout=20000)
    page.evaluate("avatar.background = null")
    page.evaluate("avatar.look({ yaw: 9, pitch: -6 })")
    page.wait_for_timeout(1000)
    camera = orbited(front_camera(trained, 64), 9, -6)
    expected = with_faded_neck(trained).render(trained.rest_params(), camera).image.clamp(0, 1)
    assert psnr(shown(page), expected) > 45
