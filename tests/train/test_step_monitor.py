"""Steps that run ahead of what is known about them; on the CPU, where everything arrives at once."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avatar.losses.photometric import PhotometricLoss
from avatar.train import step_monitor as step_monitor_module
from avatar.train.step import StepOutputs
from avatar.train.step_monitor import AsyncStepMonitor, Guard, NonFiniteStep


class Log:
    """What a TrainingLog is given."""

    def __init__(self) -> None:
        self.noted: list[tuple[int, float, dict[str, float], float]] = []

    def shows(self, step: int) -> bool:
        return step % 2 == 0

    def note(self, step: int, total: float, terms: dict[str, float], quality: float) -> None:
        self.noted.append((step, total, terms, quality))


def loss_of(value: float) -> PhotometricLoss:
    total = torch.tensor(value)
    return PhotometricLoss(total, 0.5 * total, 0.25 * total, 0.25 * total)


def outcome_of(value: float) -> StepOutputs:
    return StepOutputs(loss_of(value), torch.zeros(4, 4, 3), torch.full((4, 4, 3), 0.1))


@pytest.fixture
def weights() -> list[Tensor]:
    return [torch.nn.Parameter(torch.ones(3)), torch.nn.Parameter(torch.ones(2, 2))]


def adam(weights: list[Tensor]) -> torch.optim.Adam:
    return torch.optim.Adam(weights, lr=0.1, fused=True)


@pytest.mark.parametrize("where", ["loss", "gradient", "norm"])
def test_from_a_step_that_is_not_finite_on_nothing_moves(weights: list[Tensor], where: str) -> None:
    optimizer = adam(weights)
    guard = Guard(optimizer, torch.device("cpu"))
    for step in range(5):
        for weight in weights:
            weight.grad = torch.ones_like(weight)
        if step == 2 and where == "gradient":
            weights[1].grad[0, 1] = torch.nan  # type: ignore[index]
        if step == 2 and where == "norm":
            weights[1].grad.fill_(3e38)  # type: ignore[union-attr]
        before = [weight.detach().clone() for weight in weights]
        counted = {id(weight): optimizer.state[weight].get("step", torch.zeros(())).clone() for weight in weights}
        guard.check_gradients(
            loss_of(float("inf") if step == 2 and where == "loss" else 1.0), [w.grad for w in weights]
        )  # type: ignore[misc]
        optimizer.step()
        moved = [not torch.equal(weight, old) for weight, old in zip(weights, before, strict=True)]
        assert moved == [step < 2] * 2, step
        for weight in weights:
            assert float(optimizer.state[weight]["step"]) == float(counted[id(weight)]) + (step < 2)


def test_a_guard_changes_no_bit_of_a_step(weights: list[Tensor]) -> None:
    results = []
    for guarded in (False, True):
        own = [torch.nn.Parameter(weight.detach().clone()) for weight in weights]
        optimizer = adam(own)
        guard = Guard(optimizer, torch.device("cpu")) if guarded else None
        for step in range(4):
            for weight in own:
                weight.grad = torch.linspace(-1, 1 + step, weight.numel()).reshape(weight.shape)
            if guard:
                guard.check_gradients(loss_of(1.0), [weight.grad for weight in own])  # type: ignore[misc]
            optimizer.step()
        results.append([weight.detach() for weight in own])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_numbers_are_logged_in_order_with_all_terms(weights: list[Tensor]) -> None:
    log = Log()
    ahead = AsyncStepMonitor(log, adam(weights), torch.device("cpu"))  # type: ignore[arg-type]
    for step in (1, 2, 3):
        ahead.note(step, outcome_of(float(step)))
    ahead.flush()
    assert [(step, total) for step, total, _, _ in log.noted] == [(1, 1.0), (2, 2.0), (3, 3.0)]
    assert log.noted[1][2] == {"total": 2.0, "frame": 1.0, "mouth": 0.5, "perceptual": 0.5}
    assert log.noted[1][3] == pytest.approx(20.0)  # of an error of 0.1, in dB


def test_a_step_that_is_not_finite_is_named_and_not_logged(weights: list[Tensor]) -> None:
    log = Log()
    ahead = AsyncStepMonitor(log, adam(weights), torch.device("cpu"))  # type: ignore[arg-type]
    for step, value in enumerate((1.0, float("nan"))):
        ahead.check_gradients(loss_of(value), [torch.ones(3)])
        if step == 0:
            ahead.note(step + 1, outcome_of(value))
    with pytest.raises(NonFiniteStep) as caught:
        ahead.note(2, outcome_of(float("nan")))
    assert caught.value.step == 1 and [step for step, *_ in log.noted] == [1]


def test_only_so_many_steps_are_ahead(weights: list[Tensor], monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU that takes its time: a note arrives only when somebody waits for it."""
    log, waited = Log(), []

    def arrives_late(note: step_monitor_module._Note, wait: bool) -> bool:
        waited.append(note.step) if wait else None
        return wait

    monkeypatch.setattr(step_monitor_module._Note, "has_arrived", arrives_late)
    monkeypatch.setattr(step_monitor_module, "MOST_AHEAD", 3)
    ahead = AsyncStepMonitor(log, adam(weights), torch.device("cpu"))  # type: ignore[arg-type]
    for step in range(1, 6):
        ahead.note(step, outcome_of(1.0))
        assert len(log.noted) == max(step - 3, 0)
    ahead.flush()
    assert waited == [1, 2, 3, 4, 5] == [step for step, *_ in log.noted]
