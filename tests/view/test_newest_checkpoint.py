"""A viewer beside a training: it takes up what training writes."""

from __future__ import annotations

import shutil
from argparse import Namespace
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("viser")
from command_line import avatar
from view_client import TOKEN, WIDTH, Page
from waiting import until

from avatar.commands.view import follow
from avatar.files.lock import locked
from avatar.runs.avatar_file import write_avatar
from avatar.runs.run import open_trained
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.newest_checkpoint import NewestAvatar, progress
from avatar.view.viewer import Viewer


@pytest.fixture
def shown(shown_avatar: TrainedAvatar, tmp_path: Path) -> TrainedAvatar:
    """In a run of its own."""
    run = tmp_path / "run"
    shutil.copytree(shown_avatar.source.parent, run)
    return replace(shown_avatar, source=run / shown_avatar.source.name)


def train_on(shown: TrainedAvatar, steps: int) -> bytes:
    """Write what training would, `steps` later; the bytes of the file."""
    model = deepcopy(shown.avatar)
    with torch.no_grad():
        dict(model.named_parameters())["sh_dc"].add_(0.5)
    recording, neutral, step = shown.recording, shown.neutral, shown.step + steps
    write_avatar(shown.source, model, shown.config, recording, neutral, step, shown.perceptual)
    return shown.source.read_bytes()


def opened(shown: TrainedAvatar, newest: NewestAvatar) -> TrainedAvatar | None:
    return newest.poll(shown, lambda: open_trained(shown.source))


def test_a_newer_avatar_is_opened_once_it_is_whole(shown: TrainedAvatar) -> None:
    newest = NewestAvatar(shown.source)
    assert opened(shown, newest) is None
    data = train_on(shown, 3)
    for part in (data[: len(data) // 2], b"", data[:-1]):
        shown.source.write_bytes(part)
        assert opened(shown, newest) is None
    shown.source.unlink()
    assert opened(shown, newest) is None
    shown.source.write_bytes(data)
    newer = opened(shown, newest)
    assert newer is not None and newer.step == shown.step + 3
    assert opened(newer, newest) is None


def test_an_avatar_of_another_video_is_not_taken_for_a_newer_one(shown: TrainedAvatar) -> None:
    newest = NewestAvatar(shown.source)
    train_on(replace(shown, recording=replace(shown.recording, data_hash="0" * 64)), 3)
    assert opened(shown, newest) is None


def test_how_far_training_is(shown: TrainedAvatar) -> None:
    run = shown.source.parent
    assert progress(shown, run) == "Step 4 of 4: finished"
    early = replace(shown, step=3)
    assert progress(early, run) == "Step 3 of 4: interrupted"
    with locked(run):
        assert progress(early, run) == "Step 3 of 4: training"


def test_a_picture_that_could_not_be_drawn_is_drawn_later(viewer: Viewer) -> None:
    until(lambda: viewer.picture is not None)
    before, renderer = viewer.picture, viewer.renderer.of(viewer.renderer.trained)
    draw, failures = renderer.draw, ["the GPU's memory is full: training has it"]

    def draw_later(*arguments: Any) -> np.ndarray:
        if failures:
            raise RuntimeError(failures.pop())
        return draw(*arguments)

    renderer.draw = draw_later  # type: ignore[method-assign]
    viewer.renderer = renderer
    until(lambda: viewer.picture is not before)
    assert not failures


def test_the_viewer_shows_what_training_writes(
    shown: TrainedAvatar, viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = viewer.renderer = viewer.renderer.of(shown)
    arguments, seconds = Namespace(run=shown.source.parent, head=None), []

    def sleep(length: float) -> None:
        seconds.append(length)
        if len(seconds) == 1:
            train_on(shown, 3)
        elif len(seconds) == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("avatar.commands.view.time", Namespace(sleep=sleep))
        follow(viewer, NewestAvatar(shown.source), arguments)
    until(lambda: viewer.renderer is not before)
    now = viewer.player.now()
    picture, old = (r.draw((now.params, now.camera), viewer.setting, WIDTH) for r in (viewer.renderer, before))
    until(lambda: viewer.picture is not None and np.array_equal(viewer.picture, picture))
    assert not np.array_equal(picture, old)
    with Page(f"http://127.0.0.1:{viewer.port}/{TOKEN}/") as page:
        page.until(lambda: "Step 7 of 4: finished" in str(page.values) and "Training" in page.folders)


def test_before_the_first_checkpoint_the_sentence_says_to_wait(shown: TrainedAvatar) -> None:
    shown.source.unlink()
    said = avatar("view", shown.source.parent, status=1)
    assert "no checkpoint has been written yet; wait for the first" in said
