from __future__ import annotations

import math

import pytest
import torch
from small_runs import new_avatar, open_small, small_config

from avatar.train.optimizer import make_optimizer, schedule, set_rates


def test_without_schedule_every_step_has_the_full_rates() -> None:
    trainer = small_config("experiment=paper", "trainer.iterations=50").trainer
    assert [schedule(step, trainer) for step in range(50)] == [1.0] * 50


def test_the_rates_rise_then_fall_by_half_a_cosine() -> None:
    trainer = small_config("trainer.iterations=401").trainer
    shares = [schedule(step, trainer) for step in range(401)]
    assert shares[:20] == pytest.approx([(step + 1) / 20 for step in range(20)], rel=6e-3)
    assert shares[200] == pytest.approx(0.525) and shares[400] == pytest.approx(0.05)
    assert shares[100] == pytest.approx(0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi / 4)))
    assert shares[20:] == sorted(shares[20:], reverse=True)


def test_every_group_keeps_its_own_rate(tracked_folder) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    optimizer = make_optimizer(new_avatar(assets, subject, config), config.trainer)
    full = [group["lr"] for group in optimizer.param_groups]
    for share in (0.5, 0.25):
        set_rates(optimizer, share)
        assert [group["lr"] for group in optimizer.param_groups] == [rate * share for rate in full]
    assert torch.tensor(full).min() > 0
