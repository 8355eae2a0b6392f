"""What a training is foretold to take."""

from __future__ import annotations

from collections import Counter

import pytest
from small_runs import small_config

from avatar.losses.photometric import dssim
from avatar.train.cost_estimate import kinds_of_steps
from avatar.train.objective import PerceptualTerm, Weighted


@pytest.mark.parametrize("iterations", [1, 2, 9, 10, 11, 40, 41, 53])
@pytest.mark.parametrize("start", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("every", [1, 2, 10])
def test_steps_are_counted_by_what_their_loss_takes(
    iterations: int, start: float, every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("avatar.train.objective.PERCEPTUAL_START", start)
    trainer = small_config(f"trainer.iterations={iterations}").trainer
    term = PerceptualTerm("x", Weighted(dssim, 3.0), every, Weighted(dssim, 2.0), Weighted(dssim, 1.0))
    begin = round(start * iterations)
    found = {term.at(step, begin): count for count, step in kinds_of_steps(trainer, every)}
    assert found == Counter(term.at(step, begin) for step in range(iterations))
