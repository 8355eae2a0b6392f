"""Noise on the network's input in training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from poison import poisoned_recording
from small_runs import open_small, small_config, train_small

from avatar.data.subject import Subject
from avatar.model import HyperGaussianAvatar
from avatar.train.condition_noise import ConditionNoise, make_noise

SHARE = 0.3


@pytest.fixture
def subject(tracked_folder: Path) -> Subject:
    return open_small(tracked_folder, small_config())[1]


def conditions_of(subject: Subject) -> torch.Tensor:
    return torch.stack([params.condition() for params in subject.recording.motion(subject.split.train)])


def test_noise_spreads_as_the_conditions_do(subject: Subject) -> None:
    conditions = conditions_of(subject)
    noise = ConditionNoise(conditions, SHARE, seed=3)
    added = torch.stack([noise.of(step) for step in range(4000)])
    expected = SHARE**2 * np.cov(conditions.numpy().T, bias=True)
    found = added.double().numpy().T @ added.double().numpy() / len(added)
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    assert np.isfinite(found).all() and scale.max() > 0
    assert np.abs(found - expected).max() < 0.1 * scale.max()  # six deviations of chance
    still = scale.diagonal() < 1e-12
    assert still.any() and found.diagonal()[still].max() < 1e-10  # what never moves has none


def test_noise_spreads_as_training_frames_do(subject: Subject) -> None:
    trainer = small_config(f"trainer.condition_noise={SHARE}").trainer
    clean, other = (make_noise(one, trainer) for one in (subject.recording, poisoned_recording(subject.recording)))
    assert clean is not None and other is not None
    assert all(torch.equal(clean.of(step), other.of(step)) for step in range(3))
    training = ConditionNoise(conditions_of(subject), SHARE, trainer.seed)
    assert torch.equal(clean.of(5), training.of(5)) and clean.of(5).any()


def test_noise_is_a_function_of_seed_and_step(subject: Subject) -> None:
    conditions = conditions_of(subject)
    noise = ConditionNoise(conditions, SHARE, seed=3)
    assert torch.equal(noise.of(7), noise.of(7))
    for other in (noise.of(8), ConditionNoise(conditions, SHARE, seed=4).of(7), torch.zeros_like(noise.of(7))):
        assert not torch.equal(noise.of(7), other)


def test_noise_of_several_steps_is_that_of_each(subject: Subject) -> None:
    noise = ConditionNoise(conditions_of(subject), SHARE, seed=3)
    torch.testing.assert_close(noise.of_steps(range(5, 9)), torch.stack([noise.of(step) for step in range(5, 9)]))


@pytest.mark.parametrize("share", [0.0, SHARE])
def test_training_poses_the_mesh_without_it(
    share: float, tracked_folder: Path, subject: Subject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network's input has noise; the posed mesh and previews have none."""
    known, posed, told = set(), set(), set()
    for index in range(len(subject)):
        known.add(tuple(subject.recording.params(index).condition().tolist()))
    forward, vertices = HyperGaussianAvatar.forward, HyperGaussianAvatar.vertices

    def listening(self: HyperGaussianAvatar, params, *given, **named):  # type: ignore[no-untyped-def]
        if torch.is_grad_enabled():
            told.add(tuple(params.condition().tolist()))
        else:
            assert tuple(params.condition().tolist()) in known
        return forward(self, params, *given, **named)

    def posing(self: HyperGaussianAvatar, params):  # type: ignore[no-untyped-def]
        posed.add(tuple(params.condition().tolist()))
        return vertices(self, params)

    monkeypatch.setattr(HyperGaussianAvatar, "forward", listening)
    monkeypatch.setattr(HyperGaussianAvatar, "vertices", posing)
    train_small(tracked_folder, tmp_path / "run", [f"trainer.condition_noise={share}"])
    assert told and (told <= known if share == 0 else not told & known)
    assert posed <= known
