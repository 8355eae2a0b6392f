"""The exported page for people who see little or use no mouse: axe-core's rules, and every control by the keyboard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from access import OPEN, SIZES, violations

from avatar.export.web_page import write_page
from avatar.runs.trained import TrainedAvatar

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
# What has the focus, whether it has a ring, and whether nothing lies over it.
FOCUSED = """() => {
  const one = document.activeElement, shown = one.closest(".button") ?? one, box = shown.getBoundingClientRect();
  const ring = getComputedStyle(shown), top = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
  const isRinged = ring.outlineStyle === "solid" && parseFloat(ring.outlineWidth) >= 2;
  return [one.id || one.name || one.textContent, isRinged, shown.contains(top) || top?.contains(shown) === true];
}"""


@pytest.fixture(scope="module")
def page_file(trained: TrainedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(trained, tmp_path_factory.mktemp("page") / "someone.html", webcam=True).path


@pytest.mark.chromium
@pytest.mark.parametrize("query", ["", "&noui"])
@pytest.mark.parametrize("size", SIZES)
def test_axe_finds_nothing(visit: Any, query: str, size: str) -> None:
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
