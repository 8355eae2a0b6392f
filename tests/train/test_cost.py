"""The estimate of what a training takes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from small_runs import new_avatar, open_small, small_config

from avatar.errors import UserError
from avatar.losses.photometric import dssim
from avatar.train import cost_estimate
from avatar.train.cost_estimate import kinds_of_steps, measure_cost
from avatar.train.loss import PerceptualTerm, Weighted
from avatar.train.trainer import initialize_from_frames


@pytest.mark.parametrize("iterations", [1, 2, 9, 10, 11, 40, 41, 53])
@pytest.mark.parametrize("start", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("every", [1, 2, 10])
def test_steps_are_counted_by_what_their_loss_takes(
    iterations: int, start: float, every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("avatar.train.loss.PERCEPTUAL_START", start)
    trainer = small_config(f"trainer.iterations={iterations}").trainer
    term = PerceptualTerm("x", Weighted(dssim, 3.0), every, Weighted(dssim, 2.0), Weighted(dssim, 1.0))
    begin = round(start * iterations)
    found = {term.at(step, begin): count for count, step in kinds_of_steps(trainer, every)}
    assert found == Counter(term.at(step, begin) for step in range(iterations))


@pytest.mark.parametrize("time", [None, 2])
def test_any_frame_shows_what_training_takes(tracked_folder: Path, time: int | None) -> None:
    """Where the first frames are held out, the first training frame is not frame 0; cameras of a rig share times."""
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    frame = replace(subject.frame(5), shared_time=time)
    cost = measure_cost(frame, subject, assets, config)
    assert cost.step_seconds > 0 and cost.iterations == config.trainer.iterations


def test_steps_are_measured_where_training_begins(tracked_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Free Gaussians that have no place yet are all at one, each a metre large: drawing them takes another time."""
    config = small_config("model=gaussianheadavatar", "trainer.perceptual=dssim", "trainer.iterations=1")
    _, subject, assets = open_small(tracked_folder, config)
    measured = []
    monkeypatch.setattr(cost_estimate.StepRunner, "make", lambda steps, *_: measured.append(steps._state.avatar))
    measure_cost(subject.frame(5), subject, assets, config)
    trained = new_avatar(assets, subject, config)
    initialize_from_frames(trained, subject, config)
    for name, value in trained.state_dict().items():
        assert torch.equal(value, measured[0].state_dict()[name]), name
    config.trainer.initialization, config.model.name = "surface", "flashavatar"
    with pytest.raises(UserError, match="initialization=surface is for model=gaussianheadavatar"):
        measure_cost(subject.frame(5), subject, assets, config)


@pytest.mark.parametrize(("durations", "mean"), [((30.0,), 30.0), ((7.0, 4.0), 4.0), ((1.0, 0.2, 0.3, 0.4), 0.3)])
def test_slow_steps_are_measured_few_times(
    durations: tuple[float, ...], mean: float, tracked_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = small_config("trainer.perceptual=dssim", "trainer.iterations=1")
    _, subject, assets = open_small(tracked_folder, config)
    frame, clock, steps = subject.frame(5), [0.0], iter(durations)
    monkeypatch.setattr(cost_estimate, "time", SimpleNamespace(perf_counter=lambda: clock[0]))

    def make(*_: object) -> None:
        clock[0] += next(steps)

    monkeypatch.setattr(cost_estimate.StepRunner, "make", make)
    assert measure_cost(frame, subject, assets, config).step_seconds == pytest.approx(mean)
    assert next(steps, None) is None, "not all of them were made"
