from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_runs import new_avatar, open_small, small_config

from avatar.train import step_runner as step_runner_module
from avatar.train.loss import PerceptualTerm, TrainingLoss
from avatar.train.optimizer import make_optimizer
from avatar.train.step import TrainState
from avatar.train.step_runner import StepRunner


def test_meshes_are_those_of_the_head_and_are_kept_while_there_is_room(
    tracked_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    avatar, frames = new_avatar(assets, subject, config), [subject.frame(i) for i in range(3)]
    monkeypatch.setattr(step_runner_module, "MESH_BYTES", 2 * avatar.mesh.neutral_vertices().nbytes)
    objective = TrainingLoss(config.trainer, torch.ones(3), PerceptualTerm("none"))
    steps = StepRunner(TrainState(avatar, make_optimizer(avatar, config.trainer), objective))
    first = [steps.vertices(frame) for frame in frames]
    again = [steps.vertices(frame) for frame in frames]
    for frame, mesh in zip(frames, first, strict=True):
        assert torch.equal(mesh, avatar.vertices(frame.params))
    assert [a is b for a, b in zip(first, again, strict=True)] == [True, True, False]
