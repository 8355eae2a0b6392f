"""The viewer's pictures where the avatar computes: made there, and brought to the CPU as bytes."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from interpreter import DEVICE, the_cpus_way
from lively import lively_avatar

pytest.importorskip("triton", reason="Triton is not installed")

from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.view_renderer import Setting, ViewRenderer


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    with the_cpus_way():
        return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run")


def test_pictures_are_those_of_the_cpu(trained: TrainedAvatar) -> None:
    frame = trained.recording.params(5), trained.recording.camera(5, 48)
    settings = (Setting(), Setting(overlay="mesh"), Setting(overlay="error"))
    truth = torch.full((32, 32, 3), 0.4)
    with the_cpus_way():
        stage = ViewRenderer(trained, lambda *_: truth)
        expected = [stage.draw(frame, setting, 32, 5) for setting in settings]
    there = replace(trained, avatar=deepcopy(trained.avatar).to(DEVICE))
    stage = ViewRenderer(there, lambda *_: truth)
    for setting, wanted in zip(settings, expected, strict=True):
        found = stage.draw(frame, setting, 32, 5)
        assert found.shape == wanted.shape
        assert abs(found.astype(float) - wanted).mean() < 0.02, setting.overlay  # of 255; single pixels may differ


@pytest.mark.without_kernels
def test_a_picture_reads_nothing_back_before_it_is_there(
    trained: TrainedAvatar,
) -> None:
    stage = ViewRenderer(replace(trained, avatar=deepcopy(trained.avatar).to("meta")))
    drawn = stage.rendered(trained.recording.params(5), trained.recording.camera(5, 48))
    assert drawn.image.is_meta and drawn.image.shape == (48, 48, 3)
