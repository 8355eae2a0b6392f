from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from small_runs import new_avatar, open_small, small_config, train_small

from avatar.data.frame import Frame
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.losses.lpips_network import Lpips
from avatar.losses.metrics import psnr
from avatar.losses.photometric import dssim
from avatar.runs.checkpoint import list_checkpoints, load_checkpoint, newest_checkpoint
from avatar.runs.model_registry import MODELS
from avatar.train import loss as loss_module
from avatar.train import trainer as trainer_module
from avatar.train.loss import PerceptualTerm, TrainingLoss, Weighted, choose_perceptual
from avatar.train.trainer import interruption, train
from avatar.types import Camera, HeadParams

PAPER = ("experiment=paper", "data.size=null", "trainer.perceptual=auto")  # frames of the test's size, no LPIPS weights


def test_training_gets_better_and_leaves_its_files(tracked_folder: Path, tmp_path: Path) -> None:
    scores: list[float] = []
    log_step = trainer_module.TrainingLog.step

    def record(self, step, loss, render, truth) -> None:
        scores.append(float(psnr(render, truth)))
        log_step(self, step, loss, render, truth)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer_module.TrainingLog, "step", record)
        _, done = train_small(tracked_folder, tmp_path / "run", ["trainer.iterations=120"])
    assert done == 120
    assert sum(scores[-20:]) / 20 > sum(scores[:20]) / 20 + 3.0
    assert [p.name for p in sorted((tmp_path / "run").iterdir())] == [
        "avatar.safetensors",
        "checkpoints",
        "curves.csv",
        "previews",
        "run.json",
    ]
    assert (tmp_path / "run" / "previews" / "step_00000120.png").is_file()
    assert len(list_checkpoints(tmp_path / "run" / "checkpoints")) == 3


@pytest.mark.parametrize(
    "overrides",
    [
        *([f"model={name}"] for name in ("hypergaussians", "flashavatar", "covariance", "ndgs")),
        ["model=splattingavatar"],
        ["model=monogaussianavatar"],
        ["model=gaussianheadavatar"],
        ["model=gaussianheadavatar_hyper"],
        ["model=gaussianheadavatar_ndgs"],
        PAPER,  # without the grid and the schedules of the default recipe
    ],
    ids=[*MODELS, "paper"],
)
def test_a_resumed_run_has_the_bits_of_an_uninterrupted_one(
    tracked_folder: Path, tmp_path: Path, overrides: Sequence[str]
) -> None:
    """Across the boundaries where a spherical-harmonics degree and the perceptual term come in."""
    train_small(tracked_folder, tmp_path / "whole", overrides)
    shutil.copytree(tmp_path / "whole", tmp_path / "broken")
    list_checkpoints(tmp_path / "broken" / "checkpoints")[-1].unlink()
    halfway = newest_checkpoint(tmp_path / "broken")
    assert halfway.step == 8
    train_small(tracked_folder, tmp_path / "broken", overrides, resume=halfway)

    whole, broken = newest_checkpoint(tmp_path / "whole"), newest_checkpoint(tmp_path / "broken")
    assert whole.step == broken.step == 12
    assert whole.tensors.keys() == broken.tensors.keys()
    differing = [name for name in whole.tensors if not torch.equal(whole.tensors[name], broken.tensors[name])]
    assert not differing
    assert len({(tmp_path / run / "curves.csv").read_text() for run in ("whole", "broken")}) == 1


@pytest.mark.parametrize("model", ["covariance", "ndgs", "splattingavatar", "monogaussianavatar"])
def test_the_papers_other_systems_learn(tracked_folder: Path, tmp_path: Path, model: str) -> None:
    """The pictures get nearer, and every parameter that the latent is weighed by leaves its start."""
    config = small_config(*PAPER, f"model={model}", "model.mlp_width=24", "trainer.iterations=80")
    _, subject, assets = open_small(tracked_folder, config)
    untrained = new_avatar(assets, subject, config)
    trained, _ = train_small(tracked_folder, tmp_path / "run", [*PAPER, f"model={model}", "trainer.iterations=80"])
    frame = subject.frame(subject.split.train[0])
    background = torch.ones(3)

    def score(avatar: Avatar) -> float:
        with torch.no_grad():
            image = avatar.draw(avatar(frame.params), frame.camera, background).image
        return float(psnr(image, frame.composite(background)))

    assert score(trained) > score(untrained) + 2.0
    part = getattr(trained, "hyper", None) or torch.nn.Module()
    assert {model} <= {"splattingavatar", "monogaussianavatar"} or list(part.parameters())
    for name, parameter in part.named_parameters():
        assert bool((parameter != 0).any(dim=0).all()), f"{name} did not move"


def test_a_sparse_perceptual_term_keeps_its_weight_on_average_and_has_a_stand_in() -> None:
    rare, stand_in = Weighted(lambda image, target, mask: image.sum(), 0.05), Weighted(dssim, 0.03)
    term = PerceptualTerm("test", rare, every=4, between=stand_in)
    found = [term.at(step, 10) for step in range(10, 22)]
    assert found == [Weighted(rare.function, 0.2), stand_in, stand_in, stand_in] * 3
    assert term.at(6, 10) is None and PerceptualTerm("none").at(6, 0) is None
    assert [PerceptualTerm("always", rare).at(step, 2) for step in (1, 2, 3)] == [None, rare, rare]


def test_dssim_may_begin_before_the_perceptual_term() -> None:
    late, early = Weighted(lambda image, target, mask: image.sum(), 0.05), Weighted(dssim, 0.03)
    term = PerceptualTerm("test", late, before=early)
    assert [term.at(step, 4) for step in (0, 3, 4, 5)] == [early, early, late, late]
    assert PerceptualTerm("none", before=early).at(1, 4) is None


@pytest.mark.parametrize(("early", "share"), [(0.0, [0.0, 0.0, 1.0]), (0.1, [0.5, 0.5, 1.0])])
def test_dssim_weighs_in_each_half_what_the_configuration_says(early: float, share: list[float]) -> None:
    overrides = f"trainer.dssim_early={early}", "trainer.dssim_weight=0.2", "trainer.perceptual=dssim"
    config = small_config(*overrides, "trainer.iterations=8").trainer
    objective = TrainingLoss(config, torch.ones(3), choose_perceptual(config, print))
    image, mask = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0)), torch.ones(16, 16)
    camera = Camera(torch.eye(3), torch.zeros(3), 1.0, 1.0, 8.0, 8.0, 16, 16)
    params = HeadParams(torch.zeros(1), torch.zeros(6), torch.zeros(12), torch.zeros(2), torch.zeros(6))
    frame = Frame(0, "0", camera, params, image, mask, mask, mask)
    terms = [float(objective.loss(step, frame, image, 1 - image).perceptual) for step in (0, 3, 4)]
    assert [term / terms[-1] for term in terms] == pytest.approx(share) and terms[-1] > 0.01


def test_lpips_lets_dssim_begin_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss_module, "load_lpips", lambda *_, **__: Lpips("squeeze"))
    term = choose_perceptual(small_config("trainer.dssim_early=0.3").trainer, print)
    assert term.name == "lpips-squeeze" and term.before == Weighted(dssim, 0.3)


def test_another_seed_is_another_avatar(tracked_folder: Path, tmp_path: Path) -> None:
    a, _ = train_small(tracked_folder, tmp_path / "a", ["trainer.seed=1"])
    b, _ = train_small(tracked_folder, tmp_path / "b", ["trainer.seed=2"])
    assert not torch.equal(a.deformation.output.weight, b.deformation.output.weight)


@pytest.mark.usefixtures("ctrl_c_works")
def test_an_interruption_saves_the_state_and_stops(tracked_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    log_step = trainer_module.TrainingLog.step

    def press_ctrl_c(self, step, loss, render, truth) -> None:
        log_step(self, step, loss, render, truth)
        if step == 6:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer_module.TrainingLog, "step", press_ctrl_c)
        _, done = train_small(tracked_folder, run)
    assert done == 6
    assert newest_checkpoint(run).step == 6
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("ctrl_c_works")
def test_a_second_interruption_acts_at_once() -> None:
    with pytest.raises(KeyboardInterrupt), interruption() as interrupted:
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupted()
        os.kill(os.getpid(), signal.SIGINT)
        assert not interrupted(), "the second signal was swallowed"


@pytest.mark.usefixtures("ctrl_c_works")
def test_a_second_interruption_need_not_act() -> None:
    with interruption(second_acts=False) as interrupted:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGINT)
            assert interrupted()


@pytest.mark.usefixtures("ctrl_c_works")
def test_a_signal_that_is_ignored_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interruption() as interrupted:
        os.kill(os.getpid(), signal.SIGINT)
        assert not interrupted()
    assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN


def test_a_gradient_that_is_not_finite_stops_and_leaves_the_last_checkpoint(
    tracked_folder: Path, tmp_path: Path
) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    steps = 0

    def poison(gradient: torch.Tensor) -> torch.Tensor:
        nonlocal steps
        steps += 1
        return gradient if steps <= 6 else gradient.index_fill(0, torch.tensor([3]), float("nan"))

    avatar.opacity_logits.register_hook(poison)
    with pytest.raises(UserError) as caught:
        train(avatar, subject, config, tmp_path / "run", PerceptualTerm("none"))
    message = str(caught.value)
    assert "stopped at step 7, frame " in message
    assert "the gradient of opacity_logits has 1 non-finite of" in message and "the first at [3] (nan)" in message
    files = list_checkpoints(tmp_path / "run" / "checkpoints")
    assert [load_checkpoint(p).step for p in files] == [4]
    assert bool(torch.isfinite(avatar.opacity_logits).all()), "the optimizer ran on the bad gradient"


def spoil(monkeypatch: pytest.MonkeyPatch, avatar: Avatar, tensor: str, value: float, at: int) -> None:
    """Let one Gaussian's values of a parameter become `value` in the update of step `at`."""
    log_step = trainer_module.TrainingLog.step

    def spoiling(self, step, loss, render, truth) -> None:
        log_step(self, step, loss, render, truth)
        if step == at:
            avatar.get_parameter(tensor).data[3] = value

    monkeypatch.setattr(trainer_module.TrainingLog, "step", spoiling)


@pytest.mark.parametrize(
    ("tensor", "value", "problem"),
    [
        ("log_scales", 100.0, "scales has 3 non-finite of"),
        ("sh_rest", float("inf"), "sh has 45 non-finite of"),
        ("quats", float("nan"), "quats has 4 non-finite of"),
        ("opacity_logits", float("nan"), "opacities has 1 non-finite of"),
    ],
)
@pytest.mark.parametrize(("at", "stops"), [(6, 7), (8, 8)])  # in the next step, or in the preview
def test_a_parameter_that_overflows_stops_with_step_frame_and_tensor(
    tracked_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tensor: str,
    value: float,
    problem: str,
    at: int,
    stops: int,
) -> None:
    config = small_config("trainer.perceptual=none", "trainer.checkpoint_every=4")
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    spoil(monkeypatch, avatar, tensor, value, at)
    with pytest.raises(UserError) as caught:
        train(avatar, subject, config, tmp_path / "run", PerceptualTerm("none"))
    message = str(caught.value)
    assert f"training stopped at step {stops}, frame 000" in message and problem in message
    assert "lower trainer.learning_rates" in message
    assert [load_checkpoint(p).step for p in list_checkpoints(tmp_path / "run" / "checkpoints")] == [4]


def test_a_learning_rate_that_is_far_too_high_ends_in_a_sentence(tracked_folder: Path, tmp_path: Path) -> None:
    rates = ["trainer.learning_rates.scale=10", "trainer.lr_decay=false"]
    # What overflows first, a gradient or what is drawn, is the machine's rounding.
    with pytest.raises(UserError, match="training stopped at step [0-9]+, frame [0-9]+: .+; what was saved before"):
        train_small(tracked_folder, tmp_path / "run", [*rates, "trainer.iterations=60"])
    newest = newest_checkpoint(tmp_path / "run")
    assert all(bool(torch.isfinite(tensor).all()) for tensor in newest.tensors.values())


def test_lpips_by_name_without_weights_fails_before_training(tracked_folder: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loss_module, "load_lpips", _no_weights)
        with pytest.raises(UserError, match="no weights"):
            train_small(tracked_folder, tmp_path / "run", ["trainer.perceptual=lpips-squeeze"])
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_without_weights_the_default_trains_with_dssim_and_says_so_once() -> None:
    said: list[str] = []
    term = choose_perceptual(small_config().trainer, said.append)
    assert term.name == "dssim" and len(said) == 1 and "D-SSIM in place of LPIPS" in said[0]
    assert choose_perceptual(small_config("trainer.perceptual=none").trainer, said.append).term is None
    assert len(said) == 1


def _no_weights(*_: object, **__: object) -> None:
    raise UserError("no weights")
