"""The viewer for people who see little or use no mouse: axe-core's rules, names, and folders by the keyboard."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")
from access import SIZES, violations
from browsers import chromium
from view_client import TOKEN
from waiting import until

from avatar.view.viewer import Viewer

# Of viser's own pane: its logo has no text, the server's address no label, a popup of the scene's tree no role.
FOREIGN = (".mantine-TextInput-root", "[data-scene-node]")


@pytest.fixture
def page(viewer: Viewer, request: pytest.FixtureRequest) -> Iterator[Any]:
    """With curves of a training, every folder open; the parameter holds options of the browser's context."""
    viewer.panel.draw_curves(np.linspace(1, 2, 36).reshape(6, 6), True)
    with chromium() as browser:
        page = browser.new_context(**getattr(request, "param", {})).new_page()
        page.goto(f"http://127.0.0.1:{viewer.port}/?token={TOKEN}")
        for closed in ("Brows", "Cheeks"):
            folder = page.get_by_role("button", name=closed)
            assert folder.get_attribute("aria-expanded") == "false"
            folder.press("Enter")
            until(lambda folder=folder: folder.get_attribute("aria-expanded") == "true")
        yield page


@pytest.mark.chromium
@pytest.mark.parametrize(
    "page",
    [{"viewport": size, "color_scheme": theme} for size in SIZES.values() for theme in ("light", "dark")],
    indirect=True,
)
def test_axe_finds_nothing_in_the_viewer(page: Any) -> None:
    for name in ("Play", "Reset face"):  # what the panel has scrolled away is not judged
        page.get_by_role("button", name=name).scroll_into_view_if_needed()
        assert violations(page) == []
    page.get_by_role("button", name="Play").press("Enter")
    page.get_by_text("Choose a motion first.").wait_for()
    page.locator(".u-over").first.hover()
    page.get_by_role("button", name="Enlarge").wait_for()
    assert violations(page) == []
    page.get_by_role("button", name="Configuration and diagnostics").press("Enter")
    page.get_by_text("Scene tree").wait_for()
    assert violations(page, without=FOREIGN) == []


@pytest.mark.chromium
def test_sliders_and_their_fields_have_names_and_keys(page: Any, viewer: Viewer) -> None:
    page.get_by_role("textbox", name="jaw open").fill("50")
    until(lambda: viewer.setting.joints)
    slider = page.get_by_role("slider", name="jaw open")
    assert slider.get_attribute("aria-valuenow") == "50"
    look = viewer.setting.look
    slider.press("ArrowRight", delay=500)
    until(lambda: slider.get_attribute("aria-valuenow") == "51")
    assert viewer.setting.joints.keys() == {"jaw"} and viewer.setting.look == look, "the key turns no camera"
    slider.blur()
    page.keyboard.press("ArrowRight", delay=500)
    until(lambda: viewer.setting.look != look)
