"""Names of files that are no Unicode: the page shows them escaped, where it would be closed as it opens."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser")
from view_client import TOKEN, WIDTH, Page

from avatar.commands.view import clips
from avatar.runs.motion_clip import own_clip
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.player import Player
from avatar.view.view_renderer import ViewRenderer
from avatar.view.viewer import Viewer

ODD = "caf\udce9"


def test_a_page_shows_what_plays_and_what_drives(shown_avatar: TrainedAvatar, tmp_path: Path) -> None:
    np.savez(tmp_path / f"{ODD}.npz", expression=np.zeros((2, shown_avatar.assets.num_expressions), np.float32))
    motions = clips(shown_avatar, [tmp_path / f"{ODD}.npz"])
    assert list(motions)[-1] == r"caf\udce9.npz"
    player = Player(shown_avatar, motions, time.monotonic, lambda: None)
    renderer, status = ViewRenderer(shown_avatar), f"{ODD}.mp4 has ended"
    viewer = Viewer(renderer, player, WIDTH, "127.0.0.1", 0, TOKEN, live_status=lambda: status)
    with Page(f"http://127.0.0.1:{viewer.port}/{TOKEN}/") as page:
        page.until(lambda: page.pictures and r"caf\udce9.mp4 has ended" in page.values.values())
    viewer.close()


def test_a_video_that_is_saved_has_a_name_that_browsers_take(viewer: Viewer, shown_avatar: TrainedAvatar) -> None:
    clip = own_clip(shown_avatar, "train")
    viewer.player._clips[ODD] = replace(clip, name=ODD, frames=clip.frames[:2], recorded=None)
    viewer.player.choose(ODD)
    names: list[str] = []
    client = SimpleNamespace(send_file_download=lambda name, *_, **__: names.append(name))
    viewer.save_video(SimpleNamespace(client=client))
    assert names == ["someone-caf_.mp4"]
