"""The exported page and <avatar-view>, in headless Chromium, driven as a person does."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from browsers import WEB, served
from command_line import avatar
from lively import lively_avatar, lively_run, psnr
from pages import shown, until

from avatar.export.default_view import front_camera, with_faded_neck
from avatar.export.web_page import bundle, script_text, write_page, write_web_avatar
from avatar.motion.controls import joint_ranges, posed
from avatar.motion.orbit import orbited
from avatar.runs.trained_avatar import TrainedAvatar

# A pose that blends is drawn anew in every frame of the browser; what has been still for so long has come to rest.
NEW_PICTURE = """async () => {
  const frame = () => new Promise(requestAnimationFrame);
  let drawn = performance.now();
  const note = () => (drawn = performance.now());
  avatar.addEventListener("drawn", note);
  await frame();
  await frame(); // what was set has been asked for
  while (avatar.isBusy || performance.now() - drawn < 150) await frame();
  avatar.removeEventListener("drawn", note);
}"""


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def drawn(trained: TrainedAvatar) -> TrainedAvatar:
    return with_faded_neck(trained)


@pytest.fixture(scope="module")
def page_file(trained: TrainedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(trained, tmp_path_factory.mktemp("page") / "someone.html", "float").path


@pytest.fixture
def opened(browser: Any, page_file: Path) -> Iterator[Any]:
    """The page from a file with no network and with a face that keeps still; errors and requests fail the test."""
    context = browser.new_context(offline=True, reduced_motion="reduce", viewport={"width": 1100, "height": 760})
    page = context.new_page()
    wrong: list[str] = []
    page.on("console", lambda said: wrong.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    local = ("file:", "blob:", "data:")
    page.on("request", lambda request: None if request.url.startswith(local) else wrong.append(request.url))
    page.goto(f"{page_file.as_uri()}?width=64")
    page.locator("#message").wait_for(state="hidden", timeout=20000)
    page.evaluate("avatar.background = null")  # that of training
    until(page, "avatar.canvas.width === 64")
    page.evaluate(NEW_PICTURE)
    yield page
    assert not [words for words in wrong if "GPU stall" not in words]  # a note of the software renderer
    context.close()


def after(page: Any, script: str) -> torch.Tensor:
    page.evaluate(f"(async () => {{ {script}; }})()")
    page.evaluate(NEW_PICTURE)
    return shown(page)


@pytest.mark.chromium
def test_the_page_shows_what_the_program_draws(opened: Any, trained: TrainedAvatar, drawn: TrainedAvatar) -> None:
    rest, camera = trained.rest_params(), front_camera(trained, 64)
    assert psnr(shown(opened), drawn.render(rest, camera).image.clamp(0, 1)) > 45
    low, high = opened.evaluate("[avatar.limits.yaw[0], avatar.limits.pitch[1]]")
    turned = after(opened, "avatar.look({ yaw: -999, pitch: 999, zoom: 1.5 })")
    expected = drawn.render(rest, orbited(camera, low, high, 1.5)).image.clamp(0, 1)
    assert psnr(turned, expected) > 45 and psnr(turned, shown(opened)) > 60
    assert opened.locator("#guess").is_visible(), "so far round the avatar guesses, and the page says so"


@pytest.mark.chromium
def test_a_slider_moves_the_face_as_in_the_program(opened: Any, trained: TrainedAvatar, drawn: TrainedAvatar) -> None:
    before = shown(opened)
    control = trained.expression_controls()[0]
    opened.evaluate("document.querySelectorAll('details').forEach(box => (box.open = true))")
    slider = opened.locator(f'input[name="{control.part}: {control.name}"]')
    slider.fill(str(control.high))
    opened.evaluate(NEW_PICTURE)
    value = float(slider.input_value())
    expected = drawn.render(posed(trained.rest_params(), {control: value}, {}), front_camera(trained, 64)).image.clamp(
        0, 1
    )
    moved = shown(opened)
    assert psnr(moved, before) < 40 and psnr(moved, expected) > 45
    opened.get_by_role("button", name="Reset").click()
    opened.evaluate("avatar.background = null")
    opened.evaluate(NEW_PICTURE)
    assert psnr(shown(opened), before) > 60 and float(slider.input_value()) == 0.0


@pytest.mark.chromium
def test_joints_move_as_in_the_program(opened: Any, trained: TrainedAvatar, drawn: TrainedAvatar) -> None:
    ranges = joint_ranges([trained.recording.params(i) for i in trained.recording.split.train])
    assert {"jaw", "left_lid", "look_left"} <= set(ranges)
    opened.evaluate("document.querySelectorAll('details').forEach(box => (box.open = true))")
    for name, label in (("jaw", "Jaw: open"), ("left_lid", "Eyes: left lid"), ("look_left", "Eyes: look to its left")):
        opened.locator(f'input[name="{label}"]').fill(str(ranges[name][1]))
    opened.evaluate(NEW_PICTURE)
    joints = {name: ranges[name][1] for name in ("jaw", "left_lid", "look_left")}
    expected = drawn.render(posed(trained.rest_params(), None, joints), front_camera(trained, 64)).image.clamp(0, 1)
    assert psnr(shown(opened), expected) > 45


@pytest.mark.chromium
def test_the_recorded_motion_plays_and_is_scrubbed(opened: Any, trained: TrainedAvatar, drawn: TrainedAvatar) -> None:
    recording = trained.recording
    last = recording.split.test[-1]
    scrub = opened.locator("#scrub")
    scrub.fill(scrub.get_attribute("max"))
    opened.evaluate(NEW_PICTURE)
    expected = drawn.render(recording.params(last), recording.camera(last, 64)).image.clamp(0, 1)
    assert psnr(shown(opened), expected) > 45
    button = opened.locator("#play")
    assert button.inner_text() == "Play"
    button.click()
    until(opened, "document.getElementById('play').textContent === 'Pause'")
    frame = opened.evaluate("avatar.time")
    until(opened, f"avatar.time !== {frame}")
    button.click()
    assert not opened.evaluate("avatar.isPlaying")


@pytest.mark.chromium
def test_keys_mouse_and_wheel_turn_the_head(opened: Any) -> None:
    canvas, view = opened.locator("#canvas"), "[avatar.view.yaw, avatar.view.pitch, avatar.view.zoom]"
    canvas.focus()
    for key in ("ArrowRight", "ArrowDown", "+"):
        opened.keyboard.press(key)
    yaw, pitch, zoom = opened.evaluate(view)
    assert (yaw, pitch) == (3, 3) and zoom == pytest.approx(1.1)
    opened.keyboard.press("Home")
    assert opened.evaluate(view) == [0, 0, 1]
    box = canvas.bounding_box()
    opened.mouse.move(box["x"] + 100, box["y"] + 100)
    opened.mouse.down()
    opened.mouse.move(box["x"] + 140, box["y"] + 100)
    opened.mouse.up()
    opened.mouse.wheel(0, -200)
    yaw, pitch, zoom = opened.evaluate(view)
    assert yaw == pytest.approx(70 * 40 / box["width"], rel=0.05) and abs(pitch) < 0.2 and zoom > 1.2
    assert canvas.get_attribute("role") == "img" and "arrow keys" in canvas.get_attribute("aria-label")
    name = "(e.ariaLabel || e.labels?.[0]?.innerText || e.textContent)"
    unnamed = f"Array.from(document.querySelectorAll('input,button')).filter(e => !{name})"
    assert opened.evaluate(f"{unnamed}.length") == 0


@pytest.mark.chromium
def test_webgl_draws_the_same_pictures(
    browser: Any, page_file: Path, trained: TrainedAvatar, drawn: TrainedAvatar
) -> None:
    page = browser.new_page(reduced_motion="reduce")
    page.goto(f"{page_file.as_uri()}?width=64&renderer=webgl")
    page.locator("#message").wait_for(state="hidden", timeout=20000)
    assert page.evaluate("avatar.renderer") == "webgl"
    page.evaluate("avatar.background = null")
    recording, test = trained.recording, trained.recording.split.test
    for k, i in enumerate(list(test)[:20]):
        picture = after(page, f"avatar.seek({k} / avatar.header.fps)")
        expected = drawn.render(recording.params(i), recording.camera(i, 64)).image.clamp(0, 1)
        assert psnr(picture, expected) > 40, f"frame {i}"
    page.close()


@pytest.mark.chromium
def test_a_face_at_rest_lives_unless_motion_is_to_be_reduced(browser: Any, page_file: Path) -> None:
    page = browser.new_page(reduced_motion="no-preference")
    page.goto(f"{page_file.as_uri()}?width=64")
    page.locator("#message").wait_for(state="hidden", timeout=20000)
    before = shown(page)
    page.wait_for_timeout(700)
    assert psnr(before, shown(page)) < 50
    page.close()


@pytest.mark.chromium
def test_phones_and_touch(browser: Any, page_file: Path) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(f"{page_file.as_uri()}?width=64")
    page.locator("#message").wait_for(state="hidden", timeout=20000)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing sticks out sideways"
    box = page.locator("#canvas").bounding_box()
    assert box["width"] > 340
    drag = """([id, type, x, y]) => avatar.canvas.dispatchEvent(new PointerEvent(type,
        { pointerId: id, pointerType: "touch", clientX: x, clientY: y }))"""
    page.evaluate("avatar.canvas.setPointerCapture = () => {}")  # takes real fingers only
    for id, type, x in ((1, "pointerdown", 100), (2, "pointerdown", 140), (2, "pointermove", 180)):
        page.evaluate(drag, [id, type, x, 200])
    assert page.evaluate("avatar.view.zoom") == pytest.approx(2.0)
    context.close()


@pytest.mark.chromium
def test_a_damaged_page_says_a_sentence(browser: Any, page_file: Path, tmp_path: Path) -> None:
    text = page_file.read_text()
    damaged = re.sub(r'(<script id="data" type="text/plain">.{4000}).{400}', r"\1", text)
    assert damaged != text
    (tmp_path / "damaged.html").write_text(damaged)
    page = browser.new_page()
    page.goto((tmp_path / "damaged.html").as_uri())
    until(page, "document.getElementById('message').textContent.includes('damaged')")
    page.close()


@pytest.mark.chromium
def test_the_element_in_a_page_of_ones_own(
    browser: Any, trained: TrainedAvatar, drawn: TrainedAvatar, tmp_path: Path
) -> None:
    shutil.copytree(WEB, tmp_path / "avatar-view")
    write_web_avatar(trained, tmp_path / "someone.avatar", "float")
    (tmp_path / "broken.avatar").write_bytes(b"not an avatar")
    readme = (WEB / "README.md").read_text()
    documented = re.search(r"```html\n(.*?)```", readme, re.DOTALL)
    assert documented is not None
    (tmp_path / "index.html").write_text("<!doctype html>" + documented[1].replace("anna.avatar", "someone.avatar"))
    with served(tmp_path) as url:
        page = browser.new_page(reduced_motion="reduce")
        page.goto(f"{url}/index.html")
        until(page, "document.querySelector('avatar-view').view?.isPlaying")
        page.evaluate("window.avatar = document.querySelector('avatar-view').view")
        page.evaluate("avatar.resize(64), avatar.release(), avatar.play('rest')")
        page.wait_for_timeout(600)
        expected = drawn.render(trained.rest_params(), front_camera(trained, 64)).image.clamp(0, 1)
        assert psnr(shown(page), expected) > 45
        assert page.evaluate("avatar.setExpression({ nobody: 1, 0: 0.5 })") == ["nobody"]
        said = page.evaluate(
            """() => new Promise(done => {
              const element = document.querySelector("avatar-view");
              element.addEventListener("error", e => done(e.detail), { once: true });
              element.setAttribute("src", "broken.avatar");
            })"""
        )
        assert said == "The avatar file is damaged or not one: it cannot be unpacked."
        gone = page.evaluate("document.querySelector('avatar-view').load('gone.avatar').catch(e => e.message)")
        assert gone.endswith("gone.avatar cannot be fetched (404).")
        early = "document.createElement('avatar-view')"
        refused = f"(() => {{ try {{ {early}.play(); }} catch (e) {{ return e.message; }} }})()"
        assert "not loaded yet" in page.evaluate(refused)
        closed = """async () => {
            const parts = { worker: new Worker("data:text/javascript,"), wasm: null, file: null };
            const view = new avatar.constructor(document.createElement("canvas"), parts);
            view.close();
            return view.ready.then(() => "ready", (error) => error.message);
        }"""
        assert page.evaluate(closed) == "The avatar was closed."
        page.close()


def test_the_command_writes_pages_and_element_files(tracked_folder: Path, tmp_path: Path) -> None:
    run = lively_run(tracked_folder, tmp_path / "run", "model.uv_size=12")
    out = tmp_path / "x.html"
    assert f"Page     {out}" in avatar("export", run, "--out", out)
    assert "{{" not in out.read_text() and "CC-BY-4.0" in out.read_text()
    said = avatar("export", run, "--out", tmp_path / "x.avatar", "--precision", "float")
    assert '<avatar-view src="x.avatar">' in said and (tmp_path / "x.avatar").read_bytes()[:2] == b"\x1f\x8b"
    assert "--format web is written as .html" in avatar(
        "export", run, "--format", "web", "--out", tmp_path / "x.png", status=1
    )
    refused = avatar("export", run, "--with-head", "--out", tmp_path / "y.html", status=1)
    assert "--with-head belongs to --format avatar" in refused and not (tmp_path / "y.html").exists()


def test_no_script_ends_early() -> None:
    assert script_text("'</script>'") == "'<\\/script>'"
    joined = bundle(("core.js", "motion.js"))
    assert "import " not in re.sub(r"//.*|/\*.*?\*/", "", joined, flags=re.DOTALL) and "export " not in joined
