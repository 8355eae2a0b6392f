from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_runs import train_small

from avatar.bench.render import compare, inputs, measure, next_of
from avatar.cli import main
from avatar.errors import UserError
from avatar.render import Renderer
from avatar.runs.run import open_trained
from avatar.runs.trained_avatar import TrainedAvatar

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    train_small(tracked_folder, run)
    return run


def test_quick_run_prints_a_table_and_writes_figures(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "render", str(trained), "--quick", "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "bench_render.json").read_text())
    assert written["avatar"]["step"] == 12 and written["machine"]["threads"] == torch.get_num_threads()
    (row,) = written["rows"]
    assert set(row["steps"]) == {"skinning", "embedding", "network", "heads", "apply_offsets", "splat"}
    for span in (*row["steps"].values(), row["frame"], row["latency"], row["latency_of_avatar"]):
        assert 0 < span["median"] <= span["p95"] and span["repeats"] == 3
    assert row["stream_fps"] > 0
    assert row["error"]["gaussians"] <= 1e-4 and row["error"]["image_mean"] <= 1e-5
    printed = capsys.readouterr().out
    assert f"{row['stream_fps']:.0f} fps" in printed and f"{row['latency']['median']:.2f}" in printed


def test_a_renderer_that_draws_another_picture_is_not_timed(trained: Path) -> None:
    run = open_trained(trained)
    frames = inputs(run, 32, count=2)
    background = torch.tensor(run.config.data.background)
    compare(run, Renderer(run.avatar, background), frames)
    stale = Renderer(run.avatar, background)
    with torch.no_grad():
        run.avatar.opacity_logits += 0.01
    with pytest.raises(UserError, match="the renderer is wrong, so it is not timed"):
        compare(run, stale, frames)


def test_the_frames_are_held_out_and_of_the_size_that_is_asked_for(trained: Path) -> None:
    run: TrainedAvatar = open_trained(trained)
    frames = inputs(run, 24, count=4)
    assert len(frames) == 4 and {camera.width for _, camera in frames} == {24}
    first = run.recording.split.test[0]
    assert torch.equal(frames[0][0].expression, run.recording.params(first).expression)
    split = run.recording.split._replace(test=(first,))
    one_frame = replace(run, recording=replace(run.recording, split=split))
    assert len(measure(one_frame, (16,), repeats=2)) == 1


def test_an_avatar_without_a_network_has_fewer_steps(tracked_folder: Path, tmp_path: Path) -> None:
    train_small(tracked_folder, tmp_path / "run", ["model=splattingavatar"])
    run = open_trained(tmp_path / "run")
    (row,) = measure(run, (16,), repeats=2)
    assert list(row.steps) == ["skinning", "splat"]


def test_calls_take_turns() -> None:
    call = next_of([lambda: 1, lambda: 2])
    assert [call() for _ in range(5)] == [1, 2, 1, 2, 1]
