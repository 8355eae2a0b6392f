"""Moved tracking on the GPU's path: the CPU's gradient and moves, and the same bits when resumed."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import pytest
import torch
from drawn_clip import BACKGROUND, Clip, drawn_clip, patterned_avatar, wrongly_tracked
from interpreter import DEVICE, error, the_cpus_way
from small_runs import new_avatar, open_small, small_config
from torch import Tensor

pytest.importorskip("triton", reason="Triton is not installed")

from avatar.compute.device import CPU
from avatar.gaussians.avatar import Avatar
from avatar.pose_refinement.frame_fitter import FrameFitter
from avatar.pose_refinement.motion import HeadPose
from avatar.pose_refinement.parameterization import find_parameterization
from avatar.runs.checkpoint import Checkpoint, list_checkpoints, load_checkpoint, newest_checkpoint
from avatar.splat import splat
from avatar.train import align as align_module
from avatar.train.aligned_frame import place
from avatar.train.step import choose_perceptual
from avatar.train.trainer import train

FRAME, DEGREE = 1, 2
TINY = (
    "model.uv_size=10",
    "model.latent_grid=4",
    "data.size=24",
    "trainer.perceptual=dssim",
    "trainer.iterations=10",
    "trainer.checkpoint_every=3",
    "trainer.keep_checkpoints=4",
    "trainer.prune_share=0",
)


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    with the_cpus_way():
        return patterned_avatar(tmp_path_factory.mktemp("head"), "model.uv_size=24")


@pytest.fixture(scope="module")
def clip(avatar: Avatar) -> Clip:
    with the_cpus_way():
        return wrongly_tracked(drawn_clip(avatar, frames=4, train=3))


def gradient(avatar: Avatar, clip: Clip, device: torch.device) -> tuple[Tensor, Tensor]:
    """Of a picture's squared error in the frame's values, in units; and the picture."""
    tracks, centre = clip.recording.tracks, avatar.head.neutral_vertices().mean(dim=0)
    parameterization = find_parameterization(tracks, clip.split.train, centre).on(device)
    values = parameterization.values(FRAME, torch.linspace(-0.4, 0.4, len(parameterization.index), device=device))
    fitter = FrameFitter(avatar, BACKGROUND.to(device), centre.to(device))
    frame = clip.pictures[FRAME]
    given = HeadPose(frame.camera.R_cam_world, frame.camera.t_cam_world).on(device)
    placed = place(frame, values, given, fitter.centre, DEGREE)
    params = placed.frame.params
    drawn = placed.watched(avatar(params, fitter.vertices(params)))
    image = splat(drawn, placed.frame.camera, fitter.background, sh_degree=DEGREE).image
    (image - frame.image.to(device)).square().mean().backward()
    return placed.gradient()[parameterization.index] * parameterization.unit, image.detach()


def test_a_placed_frames_picture_and_gradient_are_those_of_the_cpu(avatar: Avatar, clip: Clip) -> None:
    with the_cpus_way():
        expected, picture = gradient(avatar, clip, CPU)
    found, same_picture = gradient(deepcopy(avatar).to(DEVICE), clip, DEVICE)
    assert (same_picture.cpu() - picture).abs().mean() < 1e-5
    assert error(found, expected) < 1e-3


def trained(folder: Path, run: Path, device: torch.device, resume: Checkpoint | None = None) -> Checkpoint:
    config = small_config(*TINY)
    _, subject, assets = open_small(folder, config)
    avatar = new_avatar(assets, subject, config)
    term = choose_perceptual(config.trainer, lambda _: None, device=device)
    train(avatar, subject, config, run, term, resume=resume, device=device)
    return newest_checkpoint(run)


@pytest.fixture
def always(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames move whatever it gains; few are asked, because the interpreter takes its time."""
    for name, value in (("LEAST_GAIN", -100.0), ("SAMPLES", 1), ("JUDGED", 2)):
        monkeypatch.setattr(align_module, name, value)


@pytest.mark.usefixtures("always")
def test_a_run_moves_its_frames_as_on_the_cpu_and_goes_on_to_the_same_bits(
    tracked_folder: Path, tmp_path: Path
) -> None:
    with the_cpus_way():
        expected = trained(tracked_folder, tmp_path / "cpu", CPU)
    whole = trained(tracked_folder, tmp_path / "run", DEVICE)
    moves, wanted = whole.tensors["align.moves"], expected.tensors["align.moves"]
    assert moves.is_cpu and wanted.any()
    torch.testing.assert_close(moves, wanted, rtol=1e-2, atol=1e-3 * float(wanted.abs().max()))
    for name, value in expected.tensors.items():
        if name.startswith("model."):
            torch.testing.assert_close(whole.tensors[name], value, rtol=1e-2, atol=1e-3)

    halfway = load_checkpoint(list_checkpoints(tmp_path / "run" / "checkpoints")[0])
    assert halfway.step == 3 and halfway.tensors["align.factor"].numel()
    again = trained(tracked_folder, tmp_path / "again", DEVICE, resume=halfway)
    assert again.step == whole.step and again.tensors.keys() == whole.tensors.keys()
    assert all(torch.equal(value, again.tensors[name]) for name, value in whole.tensors.items())
