"""A whole training on the GPU's path against one on the CPU's, and what happens when a step fails in the middle."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from interpreter import DEVICE, the_cpus_way
from small_runs import new_avatar, open_small, small_config
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed")

from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.runs.checkpoint import list_checkpoints, load_checkpoint, newest_checkpoint
from avatar.train import loss as loss_module
from avatar.train import step_runner as step_runner_module
from avatar.train import trainer as trainer_module
from avatar.train.loss import choose_perceptual
from avatar.train.trainer import train
from avatar.train.zoom import Zoom

TINY = (
    "model.uv_size=10",
    "data.size=24",
    "trainer.perceptual=dssim",
    "trainer.checkpoint_every=100",
    "model.latent_grid=4",
)


def trained(
    folder: Path, run: Path, *overrides: str, on_cpu: bool = False, change: Callable[[Avatar], object] = id
) -> tuple[Avatar, list[float]]:
    """An avatar, and the loss of each step as the log was given."""
    config = small_config(*TINY, *overrides)
    _, subject, assets = open_small(folder, config)
    avatar = new_avatar(assets, subject, config)
    change(avatar)
    losses: list[float] = []
    with pytest.MonkeyPatch.context() as patch:
        note = trainer_module.TrainingLog.note

        def listening(self: object, step: int, total: float, terms: dict[str, float], quality: float) -> None:
            assert step == len(losses) + 1
            losses.append(total)
            note(self, step, total, terms, quality)  # type: ignore[arg-type]

        patch.setattr(trainer_module.TrainingLog, "note", listening)
        device = torch.device("cpu") if on_cpu else DEVICE
        term = choose_perceptual(config.trainer, lambda _: None, device=device)
        if on_cpu:
            with the_cpus_way():
                train(avatar, subject, config, run, term, device=device)
        else:
            train(avatar, subject, config, run, term, device=device)
    return avatar, losses


def test_steps_have_the_losses_of_the_cpu(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Across the steps where a spherical-harmonics degree, the perceptual term and a checkpoint come in."""
    monkeypatch.setattr(loss_module, "SH_INTERVAL", 3)
    steps = ("trainer.iterations=8", "trainer.checkpoint_every=5")
    _, expected = trained(tracked_folder, tmp_path / "cpu", *steps, on_cpu=True)
    avatar, found = trained(tracked_folder, tmp_path / "gpu", *steps)
    assert len(found) == len(expected) == 8
    assert found == pytest.approx(expected, rel=1e-4)
    assert avatar.device.type == DEVICE.type
    saved = newest_checkpoint(tmp_path / "gpu")
    assert saved.step == 8 and saved.meta["device"] == DEVICE.type
    assert all(tensor.is_cpu for tensor in saved.tensors.values())


def test_steps_of_gaussian_head_avatar_have_the_losses_of_the_cpu(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer_module, "make_zoom", lambda *_: Zoom((0.8, 1.25), 0))  # as with several cameras
    steps = ("model=gaussianheadavatar_hyper", "trainer.iterations=4")
    _, expected = trained(tracked_folder, tmp_path / "cpu", *steps, on_cpu=True)
    _, found = trained(tracked_folder, tmp_path / "gpu", *steps)
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> None:
    """No step is replayed, so that Python sees what each does."""
    monkeypatch.setattr(step_runner_module, "WARM", 1000)


def poison_gradient_at(step: int) -> Callable[[Avatar], object]:
    """The gradient of the colours is NaN at its `step`-th use (from 0), and at each that repeats it."""
    seen = {"step": 0}

    def poison(gradient: Tensor) -> Tensor:
        seen["step"] += 1
        return gradient if seen["step"] <= step else gradient * torch.nan

    return lambda avatar: avatar.sh_dc.register_hook(poison)


@pytest.mark.usefixtures("launched")
def test_a_gradient_that_is_not_finite_is_named_and_has_moved_nothing(tracked_folder: Path, tmp_path: Path) -> None:
    steps = ("trainer.iterations=9", "trainer.checkpoint_every=3")
    with pytest.raises(UserError) as caught:
        trained(tracked_folder, tmp_path / "run", *steps, change=poison_gradient_at(4))
    message = str(caught.value)
    assert "training stopped at step 5, frame " in message and "the gradient of sh_dc has" in message
    assert [load_checkpoint(path).step for path in list_checkpoints(tmp_path / "run" / "checkpoints")] == [3]


@pytest.mark.usefixtures("launched")
def test_a_step_that_is_finite_when_it_is_repeated_stops_all_the_same(tracked_folder: Path, tmp_path: Path) -> None:
    seen: list[int] = []

    def poison_once(gradient: Tensor) -> Tensor:
        seen.append(1)
        return gradient * torch.nan if len(seen) == 2 else gradient

    with pytest.raises(UserError, match="step 2, frame .*: the loss or a gradient was not finite"):
        trained(
            tracked_folder,
            tmp_path / "run",
            "trainer.iterations=4",
            change=lambda avatar: avatar.sh_dc.register_hook(poison_once),
        )


def test_a_checkpoint_of_the_gpus_path_goes_on_there_to_the_same_bits_and_on_the_cpu_to_rounding(
    tracked_folder: Path, tmp_path: Path
) -> None:
    steps = ("trainer.iterations=4", "trainer.checkpoint_every=2")
    whole, _ = trained(tracked_folder, tmp_path / "run", *steps)
    halfway = load_checkpoint(list_checkpoints(tmp_path / "run" / "checkpoints")[0])
    assert halfway.step == 2
    config = small_config(*TINY, *steps)
    _, subject, assets = open_small(tracked_folder, config)
    term = choose_perceptual(config.trainer, lambda _: None, device=DEVICE)

    again = new_avatar(assets, subject, config)
    train(again, subject, config, tmp_path / "again", term, resume=halfway, device=DEVICE)
    assert all(torch.equal(a, b) for a, b in zip(again.parameters(), whole.parameters(), strict=True))

    elsewhere = new_avatar(assets, subject, config)
    with the_cpus_way():
        term = choose_perceptual(config.trainer, lambda _: None)
        train(elsewhere, subject, config, tmp_path / "cpu", term, resume=halfway)
    for own, wanted in zip(elsewhere.parameters(), whole.parameters(), strict=True):
        torch.testing.assert_close(own, wanted.cpu(), rtol=1e-2, atol=1e-3)
