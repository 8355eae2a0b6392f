"""A viewer that runs in this process."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lively import lively_avatar, lively_run

from avatar.head.expression_names import ExpressionNames
from avatar.runs.motion_clip import own_clip
from avatar.runs.trained_avatar import TrainedAvatar, load_avatar


@pytest.fixture(scope="session")
def shown_avatar(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="session")
def named_avatar(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    """Some of its expressions have names."""
    run = lively_run(tracked_folder, tmp_path_factory.mktemp("runs") / "run", "model.uv_size=8")
    avatar = load_avatar(run, tracked_folder / "head_model")
    names = ExpressionNames(("mouth_smile_left", "mouth_smile_right", None, "brow_inner_up"))
    avatar.avatar.head.assets = replace(avatar.assets, names=names)
    return avatar


@pytest.fixture
def viewer(shown_avatar: TrainedAvatar) -> Iterator[object]:
    """96 pixels wide, with the motion `train` and a grey truth."""
    pytest.importorskip("viser")
    from view_client import TOKEN, WIDTH

    from avatar.view.player import Player
    from avatar.view.view_renderer import ViewRenderer
    from avatar.view.viewer import Viewer

    player = Player(shown_avatar, {"train": own_clip(shown_avatar, "train")}, time.monotonic)
    renderer = ViewRenderer(shown_avatar, lambda _, width: torch.full((width, width, 3), 0.4))
    viewer = Viewer(renderer, player, WIDTH, "127.0.0.1", 0, TOKEN)
    yield viewer
    viewer.close()
