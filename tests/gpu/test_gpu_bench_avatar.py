"""`avatar bench train|render` where the avatar computes on the GPU's path, and --device of all parts."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from interpreter import DEVICE
from small_runs import new_avatar, open_small, small_config, train_small

pytest.importorskip("triton", reason="Triton is not installed")

from avatar.bench import PARTS, render, train
from avatar.bench.clock import Time
from avatar.commands import bench
from avatar.commands.bench import bench_device
from avatar.errors import UserError
from avatar.runs.run import open_trained

TINY = ("model.uv_size=10", "data.size=24", "trainer.perceptual=dssim", "model.latent_grid=4")


def test_a_timed_step_is_the_gpus_and_is_not_cut(tracked_folder: Path) -> None:
    config = small_config(*TINY)
    _, subject, assets = open_small(tracked_folder, config)
    learner = train.make_learner(new_avatar(assets, subject, config).to(DEVICE), subject, config, lambda _: None)
    before = learner.avatar.sh_dc.detach().clone()
    train.run_steps(learner, late=True)
    assert learner.check_gradients is not None, "nothing is read back in a step"
    assert next(learner.frames).image.device.type == learner.avatar.device.type == DEVICE.type
    assert not torch.equal(learner.avatar.sh_dc, before)
    once = Time(1.0, 2.0, 3)
    rows = [train.Row("default", 5, 4, 9, once, once, {}, {})]
    lines = train.table(rows)
    assert len(lines) == 2 and "1.0 (2.0)" in lines[1]


def test_a_rendered_frame_is_compared_and_timed_there(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_small(tracked_folder, tmp_path / "run", (*TINY, "trainer.iterations=2"))
    trained = open_trained(tmp_path / "run")
    trained.avatar.to(DEVICE)
    monkeypatch.setattr(render, "stream_rate", lambda *_: 25.0)
    (row,) = render.measure(trained, (16,), repeats=1)
    assert row.steps == {} and row.frame.median > 0 and row.latency_of_avatar.median > 0
    assert row.error.gaussians <= 1e-4
    printed = "\n".join(render.table([row], render.describe(trained)))
    assert "whole frame" in printed and "skinning" not in printed


@pytest.mark.without_kernels
def test_a_gpu_is_for_the_parts_that_measure_one(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def choose(name: str, _: object) -> torch.device:
        asked.append(name)
        return torch.device("cuda", 1)

    monkeypatch.setattr(bench, "choose_device", choose)
    assert bench_device("train", "cuda:1") == torch.device("cuda", 1) and bench_device("splat", None).type == "cuda"
    assert asked == ["cuda:1", "auto"]
    for part in PARTS:
        if PARTS[part].on_gpu:
            continue
        assert bench_device(part, None) == bench_device(part, "cpu") == torch.device("cpu")
        with pytest.raises(UserError, match="measures the CPU only; on a GPU splat, render, train are measured"):
            bench_device(part, "cuda")
        with pytest.raises(UserError, match="device"):
            bench_device(part, "tpu")
