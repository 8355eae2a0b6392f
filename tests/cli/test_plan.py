"""What `avatar train --refine` trains for, and the file that says so."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.config import load_config
from avatar.data.source import Source
from avatar.errors import UserError
from avatar.pipeline import refine_plan
from avatar.pipeline.refine_run import refine_run


def test_what_rounds_are_trained_for() -> None:
    """Five passes over the frames, and no more than a quarter of the run's own steps; a thousand where it has as many."""
    assert refine_plan.round_steps(12000, 400) == 2000 and refine_plan.round_steps(6000, 900) == 1500
    assert (
        refine_plan.round_steps(6000, 90)
        == refine_plan.round_steps(2000, 400)
        == refine_plan.round_steps(1000, 400)
        == 1000
    )
    assert refine_plan.round_steps(300, 400) == 300 and refine_plan.round_steps(1, 400) == 1
    for seconds in (30.0, 60.0, 200.0, 900.0):
        for frames in (50, 400, 2000):
            able = refine_plan.affordable_iterations(seconds, 0.05, 10.0, 2, frames)
            needed = (able + 2 * refine_plan.round_steps(max(able, 1), frames)) * 0.05 + 2 * 10.0
            assert needed == pytest.approx(seconds, abs=0.3)
    assert refine_plan.affordable_iterations(19.0, 0.05, 10.0, 2, 50) < 0


def test_plan_survives_a_round_trip(tmp_path: Path) -> None:
    made = refine_plan.Plan(1, Source(tmp_path, tmp_path / "head_model"), ("data.size=64",), None, 1000, 77)
    made.save(tmp_path)
    assert refine_plan.Plan.load(tmp_path) == made
    content = json.loads(refine_plan.plan_file(tmp_path).read_text())
    refine_plan.plan_file(tmp_path).write_text(json.dumps(content | {"format": 1}))
    with pytest.raises(UserError, match="another version of this program"):
        refine_plan.Plan.load(tmp_path)


def test_tracking_is_not_refined_through_features(tmp_path: Path) -> None:
    run: Any = SimpleNamespace(config=load_config(["model=gaussianheadavatar"]))
    with pytest.raises(UserError, match="the refinement of a tracking needs Gaussians that have colours"):
        refine_run(run, tmp_path / "refined")


def test_no_steps_of_the_cpu_are_measured_for_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They would say "too little" of what a GPU has time for; the first round shows what it takes."""
    folder = write_tracked_folder(tmp_path / "someone", frames=14, size=40)
    source = Source(folder, folder / "head_model", frame_offset=1)
    monkeypatch.setattr(refine_plan, "choose_device", lambda *_: torch.device("cuda"))
    monkeypatch.setattr(refine_plan, "measure_cost", lambda *_: pytest.fail("measured on the CPU"))
    overrides = [*SMALL, "trainer.iterations=1000"]
    assert refine_plan.steps_in_time(source, overrides, 1, 0.001, 0.0) == (1000, 1000)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rounds", 0),
        ("rounds", True),
        ("iterations", 6000.0),
        ("round_iterations", "many"),
        ("minutes", float("nan")),
        ("minutes", "5"),
        ("minutes", 10**400),
        ("spent", float("inf")),
        ("overrides", [1]),
    ],
)
def test_a_damaged_plan_is_refused(tmp_path: Path, key: str, value: object) -> None:
    refine_plan.Plan(1, Source(tmp_path, tmp_path / "head_model"), ("data.size=64",), 5.0, 1000, 77).save(tmp_path)
    whole = json.loads(refine_plan.plan_file(tmp_path).read_text())
    refine_plan.plan_file(tmp_path).write_text(json.dumps({**whole, key: value}))
    with pytest.raises(UserError, match="is damaged"):
        refine_plan.Plan.load(tmp_path)
    del whole[key]
    refine_plan.plan_file(tmp_path).write_text(json.dumps(whole))
    with pytest.raises(UserError, match=f"is damaged: {key} is missing"):
        refine_plan.Plan.load(tmp_path)
