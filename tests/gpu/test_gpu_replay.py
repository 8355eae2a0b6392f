"""Replayed steps: what launched ones make, to the bit; and when they are not replayed."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from camera_rig_folder import write_single
from interpreter import DEVICE
from small_runs import new_avatar, open_small, small_config
from splat.scenes import SCENES
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed")

from avatar.compute.cuda_graph import Replay, own_stream
from avatar.data.source import Source
from avatar.losses.lpips_network import Lpips
from avatar.runs.checkpoint import Checkpoint, newest_checkpoint
from avatar.splat import splat
from avatar.train import loss as loss_module
from avatar.train import step_runner as step_runner_module
from avatar.train import trainer as trainer_module
from avatar.train.loss import choose_perceptual
from avatar.train.step_runner import Kind, StepRunner
from avatar.train.trainer import train
from avatar.types import Gaussians
from data_prep.prepare.open_subject import open_subject

# Degrees of the colours change at steps 3 and 6, the third term comes in at step 4, and checkpoints in between.
TINY = (
    "model.uv_size=10",
    "model.latent_grid=4",
    "data.size=24",
    "trainer.perceptual=dssim",
    "trainer.iterations=8",
    "trainer.checkpoint_every=5",
)


def trained(
    folder: Path, run: Path, monkeypatch: pytest.MonkeyPatch, *overrides: str, warm: int, degree_every: int = 3
) -> tuple[Checkpoint, StepRunner, list[float]]:
    """The last checkpoint, what made the steps, and the loss of each."""
    config = small_config(*overrides)
    if (folder / "head_model").exists():
        _, subject, assets = open_small(folder, config)
    else:
        source = Source(folder, folder.parent / "head_model")
        subject, assets = open_subject(source, config.data.test_frames, lambda _: None)
    losses: list[float] = []
    makers: list[StepRunner] = []

    class Noting(StepRunner):
        def __init__(self, *arguments: object, **named: object) -> None:
            super().__init__(*arguments, **named)  # type: ignore[arg-type]
            makers.append(self)

        def make(self, *arguments: object, **named: object):  # type: ignore[no-untyped-def]
            outcome = super().make(*arguments, **named)  # type: ignore[arg-type]
            losses.append(float(outcome.loss.total))
            return outcome

    with monkeypatch.context() as patch:
        patch.setattr(loss_module, "SH_INTERVAL", degree_every)
        patch.setattr(trainer_module, "StepRunner", Noting)
        patch.setattr(step_runner_module, "WARM", warm)
        term = choose_perceptual(config.trainer, lambda _: None, device=DEVICE)
        train(new_avatar(assets, subject, config), subject, config, run, term, device=DEVICE)
    return newest_checkpoint(run), makers[0], losses


def assert_same(found: Checkpoint, expected: Checkpoint) -> None:
    assert found.step == expected.step and found.tensors.keys() == expected.tensors.keys()
    for name, value in expected.tensors.items():
        assert torch.equal(found.tensors[name], value), name


def test_replayed_steps_have_the_bits_of_launched_ones(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With every option; those with LPIPS are without."""
    options = (*TINY, "trainer.condition_noise=0.3", "model.head_rotation=true", "model.skull_binding=true")
    expected, launching, losses = trained(tracked_folder, tmp_path / "launched", monkeypatch, *options, warm=99)
    found, replaying, same = trained(tracked_folder, tmp_path / "replayed", monkeypatch, *options, warm=1)
    assert launching.replayed == 0
    assert replaying.replayed == 8 - 4  # the first of each kind: degrees 0, 1, 1 with a third term, 2
    assert same == losses and len(set(losses)) == 8
    assert expected.tensors["pose_corrections.moves"].any()
    assert_same(found, expected)


def test_steps_with_lpips_of_the_heads_box_are_replayed(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    lpips = Lpips("squeeze").on(DEVICE)
    monkeypatch.setattr(loss_module, "load_lpips", lambda *_, **__: lpips)
    monkeypatch.setattr(loss_module, "SPARSE_EVERY", 2)
    tiny = ("data.size=40", "trainer.perceptual=lpips-squeeze", "trainer.checkpoint_every=12")
    expected, _, losses = trained(
        tracked_folder, tmp_path / "launched", monkeypatch, *TINY, *tiny, warm=99, degree_every=99
    )
    found, replaying, same = trained(
        tracked_folder, tmp_path / "replayed", monkeypatch, *TINY, *tiny, warm=1, degree_every=99
    )
    sizes = {kind.crop for kind in replaying._captured if kind.crop}
    assert sizes and all(height % 32 == 0 or height == 40 for height, _ in sizes)
    assert replaying.replayed == 8 - len(replaying._launched)
    assert same == losses
    assert_same(found, expected)


def test_cameras_of_one_size_are_replayed_with_their_own_lenses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_single(tmp_path)
    few = (*TINY, "trainer.iterations=12", "trainer.checkpoint_every=12")
    expected, _, losses = trained(folder, tmp_path / "launched", monkeypatch, *few, warm=99, degree_every=99)
    found, replaying, same = trained(folder, tmp_path / "replayed", monkeypatch, *few, warm=1, degree_every=99)
    assert len({kind.lens for kind in replaying._captured}) == 2 and replaying.replayed > 4
    assert same == losses
    assert_same(found, expected)


def test_the_kind_that_was_used_longest_ago_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    captured: list[object] = []

    def capture(*_: object) -> object:
        captured.append(object())
        return captured[-1]

    monkeypatch.setattr(step_runner_module, "Replay", capture)
    monkeypatch.setattr(step_runner_module, "KEPT", 2)
    monkeypatch.setattr(step_runner_module, "WARM", 0)
    runner: Any = StepRunner.__new__(StepRunner)
    vars(runner).update(_captured=OrderedDict(), _launched=Counter(), _pool=None)
    lens = (40.0, 40.0, 20.0, 20.0)
    often, *seldom = (Kind((40, 40), 0, None, (side, side), lens) for side in (32, 40, 48))
    for kind in (often, seldom[0], often, seldom[1], often):
        assert runner._ready(kind, 0, SimpleNamespace(tensors=dict), lambda *_: None) in captured
    assert len(captured) == 3 and list(runner._captured) == [seldom[1], often]


def test_what_cannot_be_captured_is_launched_and_said(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few = (*TINY, "trainer.iterations=4")
    expected, _, _ = trained(tracked_folder, tmp_path / "launched", monkeypatch, *few, warm=99)

    def refuse(*_: object) -> None:
        raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr(step_runner_module, "Replay", refuse)
    found, steps, _ = trained(tracked_folder, tmp_path / "run", monkeypatch, *few, warm=1)
    said = capsys.readouterr().err
    assert said.count("because they cannot be replayed: operation not permitted") == 1
    assert steps.replayed == 0
    assert_same(found, expected)


def test_a_replay_reads_what_it_is_given_each_time() -> None:
    weight = torch.full((3,), 2.0, device=DEVICE)

    def function(inputs: Mapping[str, Tensor]) -> Tensor:
        return (weight * inputs["values"])[inputs["index"]]

    values, index = torch.arange(3.0, device=DEVICE), torch.tensor([2, 0], device=DEVICE)
    inputs = {"values": values, "index": index}
    with own_stream(DEVICE):
        function(inputs)
        replay = Replay(function, inputs)
        assert replay(inputs).tolist() == [4.0, 0.0]
        assert replay({"values": values + 1.0, "index": index.flip(0)}).tolist() == [2.0, 6.0]
        weight.fill_(3.0)
        assert replay(inputs).tolist() == [6.0, 0.0]


def test_a_replayed_drawing_follows_its_camera() -> None:
    scene = SCENES["17x33"]
    gaussians, background = Gaussians(*(t.to(DEVICE) for t in scene.gaussians)), scene.background.to(DEVICE)

    def function(pose: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        R, t = (pose[name].detach().requires_grad_() for name in ("R", "t"))
        camera = replace(scene.camera, R_cam_world=R, t_cam_world=t)
        image = splat(gaussians, camera, background, backend="gpu").image
        return image.detach(), *torch.autograd.grad(image.square().sum(), (R, t))

    R, t = scene.camera.R_cam_world.to(DEVICE), scene.camera.t_cam_world.to(DEVICE)
    poses = [{"R": R, "t": t}, {"R": R.roll(1, 0).contiguous(), "t": t + 0.1}, {"R": R, "t": t + 0.02}]
    with own_stream(DEVICE):
        expected = [function(pose) for pose in poses]
        replay = Replay(function, poses[0])
        for pose, wanted in zip(poses, expected, strict=True):
            assert all(torch.equal(a, b) for a, b in zip(replay(pose), wanted, strict=True))
    assert (expected[0][0] != expected[2][0]).any() and all(part.any() for part in expected[2])
