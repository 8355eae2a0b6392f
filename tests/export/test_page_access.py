"""The exported page for people who see little or use no mouse: axe-core's rules, and every control by the keyboard."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from access import OPEN, SIZES, violations
from pages import until

from avatar.export.web_page import write_page
from avatar.runs.trained_avatar import TrainedAvatar

# All that the page shows at one time or another; the shade over the picture hides from axe-core what lies below.
SHOW_ALL = f"""() => {{
  {OPEN};
  document.querySelectorAll("[hidden]").forEach((one) => (one.hidden = one.id === "video"));
  document.getElementById("message").textContent = "A sentence";
  document.querySelector("#presets button").setAttribute("aria-pressed", "true");
}}"""
WITHOUT_SHADE = ".frame::after { content: none }"
CONTROLS = """() => Array.from(document.querySelectorAll("canvas, button, input, summary"))
  .filter((one) => one.checkVisibility() && !one.disabled)
  .map((one) => one.id || one.name || one.textContent)"""
# What has the focus, whether it has a ring (the picture's lies over its shade), and whether nothing lies over it.
FOCUSED = """() => {
  const one = document.activeElement, shown = one.closest(".button") ?? one, box = shown.getBoundingClientRect();
  const ring = one.id === "canvas" ? getComputedStyle(one.parentElement, "::after") : getComputedStyle(shown);
  const top = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
  const isRinged = ring.outlineStyle === "solid" && parseFloat(ring.outlineWidth) >= 2;
  return [one.id || one.name || one.textContent, isRinged, shown.contains(top) || top?.contains(shown) === true];
}"""
SHOWN = "[...avatar.parameters, avatar.view.yaw, avatar.view.pitch, avatar.time].join()"


@pytest.fixture(scope="module")
def page_file(trained: TrainedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(trained, tmp_path_factory.mktemp("page") / "someone.html", webcam=True).path


@pytest.mark.chromium
@pytest.mark.parametrize(("size", "query"), [("desktop", ""), ("phone", ""), ("phone", "&noui")])
def test_axe_finds_nothing(visit: Any, size: str, query: str) -> None:
    page = visit(query, reduced_motion="reduce", viewport=SIZES[size])
    page.add_style_tag(content=WITHOUT_SHADE)
    for show in ("() => {}", SHOW_ALL):
        page.evaluate(show)
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            assert violations(page, "incomplete") == [], scheme


@pytest.mark.chromium
@pytest.mark.parametrize("size", SIZES)
def test_tab_reaches_every_control_in_order_with_a_ring_and_uncovered(visit: Any, size: str) -> None:
    page = visit(reduced_motion="reduce", viewport=SIZES[size])
    page.evaluate(SHOW_ALL)
    page.evaluate("document.getElementById('message').hidden = true")  # else it lies over the picture's middle
    expected = page.evaluate(CONTROLS)
    assert {"canvas", "pack", "Camera: above", "More", "copy"} <= set(expected)
    for key, names in (("Tab", expected), ("Shift+Tab", expected[-2::-1])):
        for name in names:
            page.keyboard.press(key)
            assert page.evaluate(FOCUSED) == [name, True, True], key


@pytest.mark.chromium
def test_arrow_keys_move_every_slider_and_what_it_is_about(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    page.evaluate(OPEN)
    sliders = page.locator("form [type=range]").all()
    assert len(sliders) > 15
    for slider in sliders:
        until(page, "!avatar.isBusy")
        shown, value, most = page.evaluate(SHOWN), slider.input_value(), slider.get_attribute("max")
        slider.focus()
        for _ in range(2):  # another slider may have gone one step with the same part of the face
            page.keyboard.press("ArrowLeft" if float(value) >= 0.9 * float(most or 0) else "ArrowRight")
        until(page, f"{SHOWN} !== '{shown}'")
        assert slider.input_value() != value
    page.locator("#scrub").press("End")
    until(page, "avatar.time > 0.99 * document.getElementById('scrub').max")


@pytest.mark.chromium
def test_keys_press_buttons_tick_boxes_and_open_what_is_closed(visit: Any) -> None:
    page = visit(reduced_motion="reduce")
    assert re.fullmatch(r"64 × 64 pixels, \d+ ms a picture, processor", page.locator("#speed").inner_text())
    for box in page.locator("details").all():
        box.locator("summary").press("Enter")
        assert box.locator(":scope > :not(summary)").is_visible()
    gaze, smile = page.locator("#gaze"), page.get_by_role("button", name="Smile")
    gaze.press(" ")
    assert gaze.is_checked()
    smile.press("Enter")
    assert smile.get_attribute("aria-pressed") == "true"
    page.locator("#reset").press("Enter")
    assert smile.get_attribute("aria-pressed") == "false"
    page.locator("#canvas").press("ArrowLeft")
    page.locator("#canvas").dblclick()
    assert page.evaluate("[avatar.view.yaw, avatar.view.zoom]") == [0, 1]
    page.locator("#canvas").press("f")
    until(page, "document.getElementById('full').textContent === 'Leave full screen'")
    page.locator("#full").press("Enter")
    until(page, "document.getElementById('full').textContent === 'Full screen'")
    assert page.evaluate("document.fullscreenElement === null")


@pytest.mark.chromium
@pytest.mark.parametrize(("allowed", "says"), [(["clipboard-read", "clipboard-write"], "Copied"), ([], "Selected")])
def test_the_line_to_embed_is_copied_or_selected(visit: Any, allowed: list[str], says: str) -> None:
    page = visit(reduced_motion="reduce", permissions=allowed)
    page.evaluate(OPEN)
    if not allowed:
        page.evaluate("navigator.clipboard.writeText = async () => { throw new Error() }; 0")
    page.locator("#copy").press("Enter")
    until(page, f"document.getElementById('copy').textContent === '{says}'")
    line = page.locator("#embed").input_value()
    assert page.evaluate("getSelection().toString()") == line
    assert not allowed or page.evaluate("navigator.clipboard.readText()") == line
