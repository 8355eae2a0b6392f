"""The viewer's panel, where it does not wait for the status that is shown a few times a second."""

from __future__ import annotations

import pytest

pytest.importorskip("viser")
from view_client import TOKEN, Page
from waiting import until

from avatar.view import viewer as viewer_module
from avatar.view.viewer import Viewer


def test_a_pause_moves_the_slider_to_its_frame(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_module, "STATUS_EVERY", 1e9)
    with Page(f"http://127.0.0.1:{viewer.port}/{TOKEN}/") as page:
        page.set("Motion", "train")
        until(lambda: viewer.player.duration)
        page.set("Play", True)
        until(lambda: viewer.player.seconds > 0)
        page.set("Play", True)
        until(lambda: not viewer.player.is_playing)
        with viewer.lock:  # which a press holds until the slider is where it belongs
            assert viewer.panel._scrub.value == pytest.approx(viewer.player.seconds, abs=0.005)
