"""Drawings that need more than the GPU's buffers hold: a sentence wherever one is made, and no picture that is wrong."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from drawn_clip import BACKGROUND, SIZE, drawn_clip, patterned_avatar, wrongly_tracked
from gpu.test_gpu_training import TINY
from interpreter import DEVICE, as_on_a_gpu, the_cpus_way
from lively import lively_avatar
from small_runs import new_avatar, open_small, small_config
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed")

from avatar import render as render_module
from avatar.compute.device import CPU
from avatar.data.frame import Frame
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.evaluation.draw import draw
from avatar.evaluation.protocol import ImageFormat
from avatar.pose_refinement import refine_subject as refine_module
from avatar.pose_refinement.refine_subject import _Work, frozen
from avatar.runs.checkpoint import list_checkpoints, load_checkpoint
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.splat import CannotDraw, gpu_buffers
from avatar.train import step_runner as step_runner_module
from avatar.train import trainer as trainer_module
from avatar.train.loss import choose_perceptual
from avatar.train.trainer import train
from avatar.view.view_renderer import Setting, ViewOffset, ViewRenderer

OVERFLOWS = r"drawing needs \d+ pairs of a tile and a splat, the GPU's buffers hold 3; a lower --size or model.uv_size"


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    with the_cpus_way():
        trained = lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run")
    return replace(trained, avatar=deepcopy(trained.avatar).to(DEVICE))


def frame_of(trained: TrainedAvatar, device: torch.device = DEVICE) -> Frame:
    plane = torch.ones(32, 32, device=device)
    camera, params = trained.recording.camera(5, 32), trained.recording.params(5)
    return Frame(5, "5", camera, params, torch.ones(32, 32, 3, device=device), plane, plane, plane)


DRAWN: dict[str, Callable[[TrainedAvatar], object]] = {
    "a picture": lambda trained: trained.render(trained.rest_params(), trained.rest_camera(32)),
    "a stream": lambda trained: list(streamed(trained)),
    "an evaluated frame": lambda trained: draw(
        trained.renderer, frame_of(trained, CPU), [ImageFormat((1.0, 1.0, 1.0), True, "round")]
    ),
    "a viewed frame": lambda trained: ViewRenderer(trained).draw(
        (trained.rest_params(), trained.rest_camera(32)), Setting(), 32
    ),
}


def streamed(trained: TrainedAvatar) -> list[Any]:
    frames = [(trained.rest_params(), trained.rest_camera(32))] * 4
    with pytest.MonkeyPatch.context() as patch:
        if DEVICE.type == "cpu":
            patch.setattr(render_module, "Downloads", AtOnce)
        return list(trained.renderer._stream_from_gpu(frames))


class AtOnce:
    """Copies that have arrived."""

    def __init__(self, _: torch.device) -> None: ...

    def begin(self, tensor: Tensor) -> tuple[Tensor, AtOnce]:
        return tensor.clone(), self

    def synchronize(self) -> None: ...


@pytest.mark.parametrize("what", DRAWN)
def test_a_drawing_beyond_the_buffers_is_refused_with_a_sentence(what: str, trained: TrainedAvatar) -> None:
    with as_on_a_gpu(6_000):
        DRAWN[what](replace(trained))
    with as_on_a_gpu(3), pytest.raises((UserError, CannotDraw), match=OVERFLOWS):
        DRAWN[what](replace(trained))  # with a renderer of its own: a captured frame keeps its buffers


def test_a_viewed_frame_fits_whatever_was_drawn_before(trained: TrainedAvatar, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("HEADROOM", 1), ("PER_SPLAT", 0), ("PER_TILE", 0)):
        monkeypatch.setattr(gpu_buffers, name, value)
    stage, frame = ViewRenderer(trained), (trained.rest_params(), trained.rest_camera(32))
    settings = [Setting(ViewOffset(zoom=zoom)) for zoom in (0.5, 4.0)]
    expected = [stage.draw(frame, setting, 64) for setting in settings]
    with as_on_a_gpu():
        for setting, wanted in zip(settings, expected, strict=True):
            assert (stage.draw(frame, setting, 64) == wanted).all()


def train_and_overflow(folder: Path, run: Path) -> None:
    """From the third step on the drawings need more than the buffers hold, as if the splats had grown."""
    config = small_config(*TINY, "trainer.iterations=6", "trainer.checkpoint_every=2")
    _, subject, assets = open_small(folder, config)
    save = trainer_module.save_checkpoint
    with as_on_a_gpu() as fixed, pytest.MonkeyPatch.context() as patch:

        def saved(*arguments: Any) -> None:
            save(*arguments)
            fixed.update(dict.fromkeys(fixed, 3))

        patch.setattr(trainer_module, "save_checkpoint", saved)
        term = choose_perceptual(config.trainer, lambda _: None, device=DEVICE)
        train(new_avatar(assets, subject, config), subject, config, run, term, device=DEVICE)


@pytest.mark.parametrize("warm", [1, 99], ids=["replayed", "launched"])
def test_training_stops_at_the_step_that_overflows(
    warm: int, tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if warm == 1 and DEVICE.type == "cuda":
        pytest.skip("a captured step keeps the buffers that it was captured with")
    monkeypatch.setattr(step_runner_module, "WARM", warm)
    with pytest.raises(UserError, match=OVERFLOWS) as caught:
        train_and_overflow(tracked_folder, tmp_path / "run")
    message = str(caught.value)
    assert "training stopped at step 3, frame " in message and "trainer.learning_rates" in message
    assert [load_checkpoint(path).step for path in list_checkpoints(tmp_path / "run" / "checkpoints")] == [2]


def test_refinement_names_the_frame_that_overflows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refine_module, "FINE_STEPS", 1)
    with the_cpus_way():
        avatar = patterned_avatar(tmp_path, "model.uv_size=24")
        clip = wrongly_tracked(drawn_clip(avatar, frames=4, train=3))
    with frozen(avatar):
        work = _Work(avatar.to(DEVICE), cast(Subject, clip), SIZE, BACKGROUND)
        work.levels = 1
        with as_on_a_gpu(20_000):
            assert all(psnr > 0 for _, psnr in work.measured([1], work.parameterization.given))
        factor = torch.eye(len(work.parameterization.index), device=DEVICE)
        refining: dict[str, Callable[[], object]] = {
            "way down": lambda: list(work.refined([1], [factor])),
            "measure": lambda: list(work.measured([1], work.parameterization.given)),
        }
        for what, refine in refining.items():
            with as_on_a_gpu(3), pytest.raises(UserError, match=f"frame 1 cannot be drawn: {OVERFLOWS}"):
                refine()
                pytest.fail(f"the {what} was silent")
