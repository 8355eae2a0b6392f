from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
import torch

from avatar.bench import Request
from avatar.bench.stages import Stopwatch
from avatar.bench.train import run

pytestmark = pytest.mark.slow


class Chain:
    def first(self, x: torch.Tensor) -> torch.Tensor:
        return Slow.apply(x)  # type: ignore[return-value]

    def second(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return 2 * x, x.sum()

    def end(self) -> None:
        """What is called after a backward pass ends the last of its stages."""


class Slow(torch.autograd.Function):
    """Takes a moment in its backward pass."""

    @staticmethod
    def forward(ctx: object, x: torch.Tensor) -> torch.Tensor:
        return x + 1

    @staticmethod
    def backward(ctx: object, gradient: torch.Tensor) -> torch.Tensor:
        time.sleep(0.02)
        return gradient


def test_stages_are_timed_forward_and_backward_where_the_program_runs() -> None:
    chain, stopwatch, x = Chain(), Stopwatch(), torch.ones(3, requires_grad=True)
    with (
        stopwatch.watching(chain, "first", "slow"),
        stopwatch.watching(chain, "second", "quick"),
        stopwatch.watching(chain, "end", "end"),
    ):
        for _ in range(4):
            stopwatch.lap()
            doubled, total = chain.second(chain.first(x))
            (doubled.sum() + total).backward()
            chain.end()
    assert x.grad is not None and x.grad.tolist() == [12.0] * 3, "what is computed stays the same"
    times = stopwatch.times()
    assert list(times) == ["slow", "quick", "quick, backward", "slow, backward", "end"]
    assert times["slow, backward"].median > 15 > times["quick, backward"].median and times["slow"].repeats == 2
    assert "first" not in vars(chain), "nothing is timed any more"


def test_quick_run_prints_a_table_and_writes_figures(
    tracked_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(Request(tmp_path, quick=True, inputs=(tracked_folder,), frame_offset=1))
    output = capsys.readouterr().out
    figures = json.loads((tmp_path / "bench_train.json").read_text())
    assert [row["recipe"] for row in figures["rows"]] == ["paper", "default"]
    both = {"network", "heads", "apply_offsets", "splat", "loss"}
    for row in figures["rows"]:
        assert f"{row['late']['median']:.1f} ({row['late']['p95']:.1f})" in output
        assert row["early"]["median"] > 0
        assert both | {f"{stage}, backward" for stage in both} | {"check", "optimizer"} <= row["stages"].keys()
        assert set(row["floors"]) == {"network", "heads", "optimizer", "check"} and min(row["floors"].values()) > 0
    assert {"interpolation"} <= figures["rows"][1]["stages"].keys() - figures["rows"][0]["stages"].keys()


@pytest.mark.parametrize("model", ["splattingavatar", "monogaussianavatar"])
def test_a_model_of_other_stages_has_fewer_rows(tracked_folder: Path, tmp_path: Path, model: str) -> None:
    overrides = (f"model={model}", "data.size=32")
    run(Request(tmp_path, quick=True, inputs=(tracked_folder,), overrides=overrides, frame_offset=1))
    rows = json.loads((tmp_path / "bench_train.json").read_text())["rows"]
    assert all({"splat", "loss"} <= row["stages"].keys() for row in rows)
