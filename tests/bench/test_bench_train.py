from __future__ import annotations

import json
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch
from small_runs import new_avatar, open_small, small_config

from avatar.bench import Request
from avatar.bench.stages import StagedStep
from avatar.bench.train_report import run
from avatar.errors import UserError
from avatar.train.objective import Objective, choose_perceptual
from avatar.train.optimizer import make_optimizer
from avatar.train.step import TrainState
from avatar.train.step_runner import StepRunner


@pytest.mark.parametrize("overrides", [["experiment=paper", "trainer.perceptual=dssim"], [], ["model=flashavatar"]])
def test_a_step_in_stages_is_the_trainings_step(tracked_folder: Path, overrides: list[str]) -> None:
    """To the bit: what is timed is what is done."""
    config = small_config(*overrides)
    _, subject, assets = open_small(tracked_folder, config)
    frame, number = subject.frame(3), 11
    avatars = []
    for staged in (False, True):
        avatar = new_avatar(assets, subject, config)
        optimizer = make_optimizer(avatar, config.trainer)
        objective = Objective(config.trainer, torch.ones(3), choose_perceptual(config.trainer, lambda _: None))
        for _ in range(2):
            if staged:
                StagedStep(TrainState(avatar, optimizer, objective))(number, lambda: frame)
            else:
                StepRunner(TrainState(avatar, optimizer, objective)).make(number, frame, None)
        avatars.append(dict(avatar.named_parameters()))
    whole, staged = avatars
    assert not [name for name in whole if not torch.equal(whole[name], staged[name])]


def test_quick_run_prints_a_table_and_writes_figures_and_plot(
    tracked_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(Request(tmp_path, quick=True, inputs=(tracked_folder,), frame_offset=1))
    output = capsys.readouterr().out
    figures = json.loads((tmp_path / "bench_train.json").read_text())
    assert [row["recipe"] for row in figures["rows"]] == ["paper", "default"]
    sums: list[str] = []
    for row in figures["rows"]:
        assert f"{row['late']['median']:.1f} ({row['late']['p95']:.1f})" in output
        assert set(row["floors"]) == {"network", "heads", "optimizer", "check"} and min(row["floors"].values()) > 0
        whole = sum(time["median"] for name, time in row["stages"].items() if name != "skinning")  # once a frame
        sums.append(f"{whole:.1f}")
        assert row["early"]["median"] > 0 and {"network", "network, backward", "splat", "loss"} <= row["stages"].keys()
    (line,) = (line for line in output.splitlines() if line.lstrip().startswith("sum without skinning"))
    assert line.split()[3:] == sums, "the stages of the table add up to what it says"
    assert {"interpolation"} <= figures["rows"][1]["stages"].keys() - figures["rows"][0]["stages"].keys()
    assert iio.imread(tmp_path / "bench_train.png").shape[1] > 500


@pytest.mark.parametrize("model", ["splattingavatar", "monogaussianavatar"])
def test_a_model_of_other_stages_gets_a_sentence(tracked_folder: Path, tmp_path: Path, model: str) -> None:
    request = Request(
        tmp_path, quick=True, inputs=(tracked_folder,), overrides=(f"model={model}", "data.size=32"), frame_offset=1
    )
    with pytest.raises(UserError, match=f"the stages of a step of model={model} are not timed"):
        run(request)
