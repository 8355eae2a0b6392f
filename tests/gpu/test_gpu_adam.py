"""The GPU's Adam against torch's in double precision."""

from __future__ import annotations

import copy

import pytest
import torch
from interpreter import DEVICE, error
from torch import Tensor, nn

pytest.importorskip("triton", reason="Triton is not installed")

from avatar.train.adam_gpu import GpuAdam
from avatar.train.optimizer import EPSILON, load_optimizer, optimizer_tensors, set_rates

SHAPES = ((3,), (70, 5), (), (4, 3, 2, 5), (1500,))  # that of four dimensions has its channels last in memory
RATES = (1e-2, 2e-4)


def parameters() -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    values = [torch.randn(shape, generator=generator).to(DEVICE) for shape in SHAPES]
    return [nn.Parameter(v.to(memory_format=torch.channels_last) if v.ndim == 4 else v) for v in values]


def groups_of(own: list[nn.Parameter]) -> list[dict[str, object]]:
    return [{"params": own[:2], "full_lr": RATES[0]}, {"params": own[2:], "full_lr": RATES[1]}]


def gradients(step: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(1 + step)
    return [10.0 ** (step - 3) * torch.randn(shape, generator=generator) for shape in SHAPES]


def give(own: list[nn.Parameter], step: int, dtype: torch.dtype = torch.float32) -> None:
    for parameter, gradient in zip(own, gradients(step), strict=True):
        parameter.grad = gradient.to(parameter.device, dtype)


def test_steps_are_those_of_torch() -> None:
    own = parameters()
    adam = GpuAdam(groups_of(own), eps=EPSILON, device=DEVICE)
    exact = [nn.Parameter(p.detach().cpu().double()) for p in own]
    reference = torch.optim.Adam(
        [{"params": exact[:2], "lr": RATES[0]}, {"params": exact[2:], "lr": RATES[1]}], eps=EPSILON
    )
    for step in range(6):
        share = 1.0 / (1 + step)
        set_rates(adam, share)
        for group, rate in zip(reference.param_groups, RATES, strict=True):
            group["lr"] = share * rate
        before = [p.detach().clone() for p in exact]
        give(own, step)
        give(exact, step, torch.float64)
        adam.step()
        reference.step()
        for found, expected, old in zip(own, exact, before, strict=True):
            moved = (expected - old).abs().max()
            rounding = (step + 1) * 6e-8 * expected.abs().max()  # of each sum
            assert (found.detach().cpu() - expected).abs().max() < 2e-3 * moved + rounding
            state, wanted = adam.state[found], reference.state[expected]
            assert float(state["step"]) == step + 1
            for name in ("exp_avg", "exp_avg_sq"):
                assert error(state[name], wanted[name]) < 1e-6


def test_the_first_step_is_the_rate_times_the_gradients_sign() -> None:
    """Where the bias corrections matter most."""
    own = parameters()
    before = [p.detach().clone() for p in own]
    adam = GpuAdam(groups_of(own), eps=EPSILON, device=DEVICE)
    give(own, 3)
    adam.step()
    for parameter, old, rate in zip(own, before, (RATES[0], RATES[0], RATES[1], RATES[1], RATES[1]), strict=True):
        moved = old - parameter.detach()
        torch.testing.assert_close(moved, rate * parameter.grad.sign(), rtol=1e-3, atol=3e-7)


def test_a_step_that_is_not_finite_moves_nothing() -> None:
    own = parameters()
    adam = GpuAdam(groups_of(own), eps=EPSILON, device=DEVICE)
    give(own, 0)
    adam.step()
    before = {name: value.clone() for name, value in optimizer_tensors(adam, named(own)).items()}
    values = [p.detach().clone() for p in own]
    adam.found_inf.fill_(1.0)
    give(own, 1)
    adam.step()
    assert all(torch.equal(p.detach(), old) for p, old in zip(own, values, strict=True))
    assert all(torch.equal(value, before[name]) for name, value in optimizer_tensors(adam, named(own)).items())


def test_a_loaded_state_goes_on_to_the_same_bits() -> None:
    own = parameters()
    adam = GpuAdam(groups_of(own), eps=EPSILON, device=DEVICE)
    for step in range(3):
        give(own, step)
        adam.step()
    saved = (
        copy.deepcopy([p.detach() for p in own]),
        {n: v.clone() for n, v in optimizer_tensors(adam, named(own)).items()},
    )
    again = [nn.Parameter(value) for value in saved[0]]
    resumed = GpuAdam(groups_of(again), eps=EPSILON, device=DEVICE)
    load_optimizer(resumed, named(again), saved[1])
    for step in range(3, 5):
        for parameters_, optimizer in ((own, adam), (again, resumed)):
            give(parameters_, step)
            optimizer.step()
    assert all(torch.equal(a, b) for a, b in zip(own, again, strict=True))
    assert all(float(resumed.state[p]["step"]) == 5 for p in again)


def named(own: list[nn.Parameter]) -> dict[str, nn.Parameter]:
    return {f"p{i}": p for i, p in enumerate(own)}
