"""What an exported page offers around the picture, in headless Chromium: each control does what it says."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from browsers import WEB
from pages import shown, until

from avatar.data.split import Split
from avatar.export import default_view
from avatar.export.default_view import FILLED, HAIR, front_camera, neck_fade, neck_heights, with_faded_neck
from avatar.export.glb import NOTABLE
from avatar.export.web_page import write_page
from avatar.runs.trained_avatar import TrainedAvatar

CHANGED = "(name) => Math.abs(document.querySelector(`input[name='${name}']`).value - 0)"


@pytest.mark.chromium
def test_it_opens_idle_from_the_front_on_a_stage_of_the_theme(visit: Any, trained: TrainedAvatar) -> None:
    corners = {}
    for scheme in ("light", "dark"):
        page = visit(color_scheme=scheme)
        assert page.evaluate("avatar.motion") == "idle"
        assert page.evaluate("document.querySelector('.bar button').id") == "play", "Play is the first button"
        until(page, "avatar.canvas.width === 64 && !avatar.isBusy")
        corners[scheme] = float(shown(page)[0, 0].mean())
    assert corners["light"] > 0.9 and corners["dark"] < 0.3
    turn = page.evaluate("avatar.header.camera.rotation")
    assert turn == pytest.approx(front_camera(trained).R_cam_world.flatten().tolist())
    page.emulate_media(color_scheme="light")
    until(page, "avatar.background[0] > 0.9")


def test_a_page_and_a_mesh_have_the_same_idea_of_what_training_has_hardly_shown() -> None:
    found = re.search(r"const NOTABLE = ([0-9.]+);", (WEB / "controls.js").read_text())
    assert found is not None and float(found[1]) == NOTABLE


def test_the_head_is_upright_in_the_middle(trained: TrainedAvatar, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = front_camera(trained, 128)
    assert camera.R_cam_world[0, 1].abs() < 1e-6, "no roll"
    points = camera.project(trained.avatar.head.neutral_vertices())
    x, y = points[:, 0], points[:, 1]
    end, chin = neck_heights(trained)
    middle_of_neck = camera.project(torch.tensor([[0.0, (end + chin) / 2, 0.0]]))[0, 1]
    assert float(x.mean()) == pytest.approx(64, abs=3)
    assert float(y.min() + middle_of_neck) / 2 == pytest.approx(64, abs=3)
    aimed = default_view._from_the_front(trained, 0.05, 64).project(torch.tensor([[0.0, 0.05, 0.0]]))
    assert aimed[0, :2].tolist() == pytest.approx([32, 32], abs=0.01)
    monkeypatch.setattr(default_view, "FILLED", FILLED / 3)
    high = float(trained.avatar.head.neutral_vertices()[:, 1].max())
    hair = front_camera(trained, 128).project(torch.tensor([[0.0, high + HAIR * (high - chin), 0.0]]))
    assert float(hair[0, 1]) == pytest.approx(64 - 64 * FILLED / 3, abs=0.5)


def test_the_neck_fades_from_the_chin_to_its_end(trained: TrainedAvatar, monkeypatch: pytest.MonkeyPatch) -> None:
    found = neck_heights(trained)
    assert found[0] <= found[1], "this head's mesh ends at its chin"
    embedding = trained.avatar.embedding
    heights = (trained.avatar.head.neutral_vertices()[embedding.corners, 1] * embedding.barycentric).sum(dim=1)
    end, chin = heights.quantile(torch.tensor([0.1, 0.6])).tolist()
    monkeypatch.setattr(default_view, "neck_heights", lambda trained: (end, chin))
    fade = neck_fade(trained)
    assert (fade[heights <= end] == 0).all() and (fade[heights >= chin] > 0.999).all()
    assert (fade[heights.argsort()].diff() >= 0).all()
    was, kept = trained.avatar.opacity_logits.sigmoid(), with_faded_neck(trained).avatar.opacity_logits.sigmoid()
    torch.testing.assert_close(kept, was * fade, atol=2e-6, rtol=1e-4)
    half = fade[(heights - (end + chin) / 2).abs().argmin()]
    assert 1 - (1 - float(half)) ** 8 == pytest.approx(0.5, abs=0.1), (
        "eight layers stop half of the light in the middle"
    )


@pytest.mark.chromium
@pytest.mark.parametrize("motion", ["reduce", "no-preference"])
def test_presets_move_the_face_and_go_again(visit: Any, motion: str) -> None:
    page = visit(reduced_motion=motion)
    buttons = page.locator("#presets button")
    assert set(buttons.all_inner_texts()) >= {"Smile", "Surprise", "Wink", "Talk"}
    page.locator("summary", has_text="More").click()
    page.get_by_role("button", name="Surprise").click()
    until(page, f"({CHANGED})('Open mouth') > 0.01")
    assert page.get_by_role("button", name="Surprise").get_attribute("aria-pressed") == "true"
    page.get_by_role("button", name="Wink").click()
    until(page, f"({CHANGED})('Eyes: left lid') > 0.3")
    assert page.locator("#presets [aria-pressed=true]").all_inner_texts() == ["Wink"], "one at a time"
    page.get_by_role("button", name="Wink").click()
    until(page, "document.querySelectorAll('#presets [aria-pressed=true]').length === 0")
    page.get_by_role("button", name="Talk").click()
    until(page, f"({CHANGED})('Open mouth') > 0.01")
    first = page.evaluate(f"({CHANGED})('Open mouth')")
    until(page, f"Math.abs(({CHANGED})('Open mouth') - {first}) > 0.005")
    page.locator("#play").click()
    assert page.locator("#presets [aria-pressed=true]").count() == 0, "a motion takes over"


@pytest.mark.chromium
def test_a_preset_does_what_its_name_says_until_its_slider_is_moved(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    button, slider = page.get_by_role("button", name="Smile"), page.locator("input[name='Smile']")
    low, high = (float(slider.get_attribute(end)) for end in ("min", "max"))
    button.click()
    until(page, f"document.querySelector(`input[name='Smile']`).value > {0.9 * high}")
    slider.fill(str(0.5 * low))
    assert button.get_attribute("aria-pressed") == "false"
    page.wait_for_timeout(300)
    assert float(slider.input_value()) == pytest.approx(0.5 * low)


@pytest.mark.chromium
def test_what_a_preset_has_moved_is_let_go_of_when_it_ends(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    expression = "Array.from(avatar.parameters.slice(0, avatar.header.sizes.expressions)).join()"
    page.evaluate("avatar.seek(avatar.frameCount / avatar.header.fps)")
    page.wait_for_timeout(600)
    recorded = page.evaluate(expression)
    page.locator("#reset").click()
    button = page.get_by_role("button", name="Smile")
    button.click()
    until(page, "document.querySelectorAll('#presets [aria-pressed=true]').length === 1")
    page.wait_for_timeout(300)
    button.click()
    until(page, "document.querySelectorAll('#presets [aria-pressed=true]').length === 0")
    page.evaluate("avatar.seek(avatar.frameCount / avatar.header.fps)")
    page.wait_for_timeout(600)
    assert page.evaluate(expression) == recorded, "the recorded motion moves the face again"


@pytest.mark.chromium
def test_a_first_slider_moves_both_sides_and_a_double_click_undoes_it(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    slider = page.locator("input[name='Close eyes']")
    slider.fill(slider.get_attribute("max"))
    page.locator("summary", has_text="More").click()
    sides = [f"({CHANGED})('Eyes: {side} lid')" for side in ("left", "right")]
    until(page, " && ".join(f"{side} > 0.3" for side in sides))
    assert slider.evaluate("e => getComputedStyle(e).backgroundImage") != "none", "neutral is marked"
    slider.dispatch_event("dblclick")
    until(page, " && ".join(f"{side} < 0.01" for side in sides))
    cut = "Array.from(document.querySelectorAll('.row span')).filter(e => e.scrollWidth > e.clientWidth)"
    assert page.evaluate(f"{cut}.length") == 0, "labels are whole"


@pytest.mark.chromium
def test_sliders_and_time_follow_the_motion(visit: Any) -> None:
    page = visit("&autoplay")
    assert page.evaluate("avatar.isPlaying")
    assert re.fullmatch(r"\d+:\d\d / \d+:\d\d", page.locator("#time").inner_text())
    values = "Array.from(document.querySelectorAll('#first input'), e => Number(e.value)).join()"
    before = page.evaluate(values)
    until(page, f"{values} !== '{before}'")
    slider = page.locator("input[name='Open mouth']")
    page.evaluate("avatar.pause()")
    page.wait_for_timeout(600)
    p = page.evaluate(
        "(() => { const j = avatar.header.sizes.expressions; return Array.from(avatar.parameters).slice(j, j + 6); })()"
    )
    jaw = float(torch.atan2(torch.tensor(-p[5]), torch.tensor(p[4])))
    extent = float(slider.get_attribute("max")) - float(slider.get_attribute("min"))
    assert float(slider.input_value()) == pytest.approx(jaw, abs=0.01 * extent)
    still = visit("&autoplay", reduced_motion="reduce")
    assert not still.evaluate("avatar.isPlaying"), "who wants stillness has it"


@pytest.mark.chromium
def test_a_motion_of_one_frame_plays(browser: Any, trained: TrainedAvatar, tmp_path: Path) -> None:
    train, test = trained.recording.split
    recording = replace(trained.recording, split=Split(train, test[:1]))
    page = browser.new_page()
    page.goto(
        write_page(replace(trained, recording=recording), tmp_path / "a.html").path.as_uri() + "?autoplay&width=64"
    )
    until(page, "avatar.isPlaying && document.getElementById('time').textContent === '0:00 / 0:00'")
    scrub = "document.getElementById('scrub')"
    assert page.evaluate(f"[avatar.frameCount, avatar.time, {scrub}.max, {scrub}.value]") == [1, 0, "0", "0"]
    assert page.evaluate(f"{scrub}.style.getPropertyValue('--at')") == "0"
    page.close()


@pytest.mark.chromium
def test_eyes_follow_the_pointer_until_a_key_is_pressed(visit: Any) -> None:
    page = visit()
    gaze = "avatar.parameters[avatar.header.sizes.expressions + 6 + 2]"  # the sine of the angle to its left
    box = page.locator("#canvas").bounding_box()
    found = []
    for share in (0.02, 0.98):
        page.mouse.move(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
        page.wait_for_timeout(1000)
        found.append(page.evaluate(gaze))
    assert found[1] - found[0] > 0.02
    page.keyboard.press("e")
    assert not page.locator("#gaze").is_checked()
    page.mouse.move(box["x"] + 0.02 * box["width"], box["y"])
    page.wait_for_timeout(300)
    low = page.evaluate("avatar.header.joints.look_left[0]")
    assert page.evaluate(gaze) > 0.9 * low or low > -0.06, "the pointer is let go of"
    assert visit(reduced_motion="reduce").locator("#gaze").is_checked() is False


@pytest.mark.chromium
def test_eyes_follow_the_pointer_again_after_a_reset(visit: Any) -> None:
    page = visit()
    gaze = "avatar.parameters[avatar.header.sizes.expressions + 6 + 2]"
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + 0.98 * box["width"], box["y"] + 0.45 * box["height"])
    page.wait_for_timeout(1000)
    followed = page.evaluate(gaze)
    page.locator("#reset").press("Enter")
    page.wait_for_timeout(1000)
    assert page.evaluate(gaze) == pytest.approx(followed, abs=1e-3)


@pytest.mark.chromium
def test_background_full_screen_and_the_picture_alone(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    page.locator("#background").evaluate("e => { e.value = '#336699'; e.dispatchEvent(new Event('input')); }")
    until(page, "!avatar.isBusy && avatar.background[0] === 0.2")
    page.wait_for_timeout(200)
    assert torch.allclose(shown(page)[0, 0], torch.tensor([0.2, 0.4, 0.6]), atol=0.01)
    line = page.locator("#embed").input_value()
    assert line.startswith('<iframe src="someone.html?noui&autoplay&background=%23336699"')
    name = 'Ann "&quot;" <b>'
    page.evaluate("name => { avatar.header.name = name; }", name)
    page.locator("#background").dispatch_event("input")
    title = "line => new DOMParser().parseFromString(line, 'text/html').querySelector('iframe').title"
    assert page.evaluate(title, page.locator("#embed").input_value()) == f"{name}, a synthetic head"
    page.locator("#full").click()
    until(page, "document.fullscreenElement?.id === 'stage'")
    page.keyboard.press("Escape")
    page.locator("#reset").click()
    until(page, "avatar.background[0] > 0.9")
    alone = visit("&noui&background=%23336699")
    assert alone.evaluate("avatar.background") == [0.2, 0.4, 0.6]
    assert not alone.locator("aside").is_visible() and not alone.locator("#play").is_visible()
    assert alone.get_by_text("Synthetic", exact=True).is_visible()
    assert alone.locator("#canvas").bounding_box()["height"] == 760


@pytest.mark.chromium
def test_the_space_key_plays(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    page.locator("#canvas").focus()
    page.keyboard.press(" ")
    until(page, "avatar.isPlaying")
    page.keyboard.press(" ")
    assert not page.evaluate("avatar.isPlaying")
