"""The exported page's pictures: sharp where nothing moves, large where they are saved; and no button that does nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from browsers import WEB
from lively import psnr
from pages import until

from avatar.export.default_view import front_camera, with_faded_neck
from avatar.export.web_page import write_page
from avatar.runs.trained_avatar import TrainedAvatar

WIDTHS = """() => {
  window.widths = [];
  avatar.addEventListener("drawn", () => widths.push(avatar.canvas.width));
}"""


@pytest.fixture(scope="module")
def page_file(trained: TrainedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(trained, tmp_path_factory.mktemp("page") / "someone.html", "float").path


def opened(browser: Any, address: str, density: float = 1.0) -> Any:
    page = browser.new_page(
        reduced_motion="reduce", viewport={"width": 500, "height": 700}, device_scale_factor=density
    )
    page.goto(address)
    page.locator("#message").wait_for(state="hidden", timeout=20000)
    page.evaluate("avatar.background = null")  # that of training
    return page


@pytest.mark.chromium
@pytest.mark.parametrize("renderer", ["wasm", "webgl"])
def test_a_saved_picture_is_drawn_anew_with_1024_pixels(
    renderer: str, browser: Any, page_file: Path, trained: TrainedAvatar, tmp_path: Path
) -> None:
    page = opened(browser, f"{page_file.as_uri()}?width=64&renderer={renderer}")
    with page.expect_download() as download:
        page.get_by_role("button", name="Save picture").click()
    assert download.value.suggested_filename == "someone.png"
    download.value.save_as(tmp_path / "someone.png")
    saved = iio.imread(tmp_path / "someone.png")
    assert saved.shape[:2] == (1024, 1024) and page.evaluate("avatar.canvas.width") == 64
    expected = with_faded_neck(trained).render(trained.rest_params(), front_camera(trained, 1024)).image.clamp(0, 1)
    assert psnr(torch.from_numpy(saved[..., :3].astype(np.float32) / 255), expected) > 40
    page.close()


@pytest.mark.chromium
def test_what_is_saved_while_it_moves_is_what_was_shown(browser: Any, page_file: Path, tmp_path: Path) -> None:
    page = opened(browser, f"{page_file.as_uri()}?width=64")
    page.locator("#play").click()
    until(page, "avatar.isPlaying && avatar.time > 0")
    sizes = page.evaluate(
        """() => Promise.all([1200, 100, 1].map(async width => {
          const picture = await createImageBitmap(await avatar.screenshot(width));
          return [picture.width, picture.height];
        }))"""
    )
    assert sizes == [[1200, 1200], [100, 100], [32, 32]], "in the order in which they were asked for"
    assert page.evaluate("avatar.isPlaying && avatar.canvas.width === 64"), "the motion goes on"
    page.close()


@pytest.mark.chromium
def test_a_still_picture_has_the_pixels_of_the_screen(browser: Any, page_file: Path) -> None:
    page = opened(browser, page_file.as_uri(), density=3.0)
    box = page.locator("#canvas").bounding_box()  # the picture is square and lies in the middle
    sharp = round(3 * min(box["width"], box["height"]))
    assert 900 < sharp <= 2048
    until(page, f"Math.abs(avatar.canvas.width - {sharp}) <= 1")
    page.evaluate(WIDTHS)
    page.evaluate("avatar.look({ yaw: 3 })")
    until(page, f"widths.length > 1 && Math.abs(widths.at(-1) - {sharp}) <= 1")
    assert page.evaluate("widths[0]") <= 640, "what moves is drawn with fewer, and at once"
    page.set_viewport_size({"width": 300, "height": 700})
    until(page, "Math.abs(avatar.canvas.width - 3 * avatar.canvas.clientWidth) <= 1")
    page.close()


@pytest.mark.chromium
def test_what_plays_is_not_redrawn_sharp(browser: Any, page_file: Path) -> None:
    page = opened(browser, page_file.as_uri(), density=3.0)
    page.locator("#play").click()
    until(page, "avatar.isPlaying")
    page.wait_for_timeout(100)
    page.evaluate(WIDTHS)
    until(page, "widths.length > 10")
    assert page.evaluate("Math.max(...widths)") <= 640
    page.locator("#play").click()
    until(page, "avatar.canvas.width > 640")
    page.close()


@pytest.mark.chromium
def test_the_camera_is_offered_only_where_the_page_was_exported_for_it(
    browser: Any, page_file: Path, trained: TrainedAvatar, tmp_path: Path
) -> None:
    offered = write_page(trained, tmp_path / "camera.html", webcam=True).path
    for path, is_offered in ((page_file, False), (offered, True)):
        page = opened(browser, f"{path.as_uri()}?width=64")
        assert page.get_by_role("button", name="Drive with your camera").is_visible() == is_offered
        page.close()


def test_the_package_has_every_module_that_it_imports() -> None:
    files = json.loads((WEB / "package.json").read_text())["files"]
    modules = [name for name in files if name.endswith(".js")]
    for name in modules:
        for imported in re.findall(r'^import .* from "\./(.*)";', (WEB / name).read_text(), flags=re.MULTILINE):
            assert imported in files, f"{name} imports {imported}"
    assert all((WEB / name).is_file() for name in files)
