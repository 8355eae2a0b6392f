"""Corrections of the training frames' head poses, trained with the avatar."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from drawn_clip import BACKGROUND, SIZE, Clip, drawn_clip, patterned_avatar, screen_errors, wrongly_tracked
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from small_runs import small_config, train_small

from avatar.data.camera_rig import RigCamera
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement.tracking_values import HeadPose, moved_pose
from avatar.runs.checkpoint import list_checkpoints, newest_checkpoint
from avatar.train.loss import TrainingLoss, choose_perceptual
from avatar.train.optimizer import make_optimizer
from avatar.train.pose_corrections import (
    PREFIX,
    SHIFT_UNIT,
    TURN_UNIT,
    PoseCorrections,
    make_pose_corrections,
)
from avatar.train.step import TrainState
from avatar.train.step_runner import StepRunner
from avatar.types import Camera

STEPS = 280


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    return patterned_avatar(tmp_path_factory.mktemp("head"))


def corrected(avatar: Avatar, clip: Clip) -> tuple[PoseCorrections, Clip]:
    """Corrections after so many steps of an avatar that stands still, and the clip with these poses."""
    config = small_config(f"data.size={SIZE}", f"trainer.iterations={STEPS}", "trainer.pose_rate=0.02")
    train = clip.split.train
    corrections = make_pose_corrections(avatar, train, config.trainer)
    assert corrections is not None
    objective = TrainingLoss(config.trainer, BACKGROUND, choose_perceptual(config.trainer, lambda _: None))
    optimizer = make_optimizer(avatar, config.trainer, corrections)
    for group in optimizer.param_groups[:-1]:
        group["full_lr"] = 0.0
    steps = StepRunner(TrainState(avatar, optimizer, objective, corrections))
    for step in range(STEPS):
        index = train[step % len(train)]
        steps.make(step, replace(clip.pictures[index], camera=clip.recording.camera(index)), None)
    tracks = {name: value.clone() for name, value in clip.recording.tracks.items()}
    for index, row in corrections.rows.items():
        given = clip.recording.camera(index)
        camera = corrections(given, torch.tensor([row]), corrections.jacobian(given))
        tracks["R"][index], tracks["t"][index] = camera.R_cam_world.detach(), camera.t_cam_world.detach()
    return corrections, replace(clip, recording=replace(clip.recording, tracks=tracks))


def test_disturbed_poses_of_training_frames_come_back(avatar: Avatar) -> None:
    true = drawn_clip(avatar)
    wrong = wrongly_tracked(true, share=0.0, common=False)
    _, found = corrected(avatar, wrong)
    train = list(wrong.split.train)
    before = screen_errors(avatar, wrong.recording, true.recording, train)
    assert screen_errors(avatar, found.recording, true.recording, train) < 0.5 * before


def test_a_rig_has_one_correction_for_all_cameras_of_a_time() -> None:
    """It moves the head, so every camera sees what it would see of the moved head."""
    corrections = PoseCorrections([4], torch.tensor([0.01, -0.02, 0.03]))
    with torch.no_grad():
        corrections.moves[0] = torch.tensor([0.5, -1.0, 2.0, 1.5, -0.7])
    row, R, t = torch.tensor([0]), torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.01, 0.0, 0.8])
    turn = axis_angle_to_rotation_matrix(torch.tensor([[0.1, 0.6, -0.2]]))[0].double()
    lens = (90.0, 90.0, 16.0, 16.0)
    front = RigCamera("front", 32, 32, lens)
    aside = RigCamera("aside", 32, 32, lens, tuple(turn.flatten().tolist()), (0.3, -0.1, 0.2))
    # The mean of all corrections is subtracted; of a single one nothing would be left.
    corrections.moves.data = torch.cat((corrections.moves.data, -corrections.moves.data))
    seen = [one.sees(R, t) for one in (front, aside)]
    front_moved, aside_moved = (corrections(one, row, corrections.jacobian(one)) for one in seen)
    expected = aside.sees(front_moved.R_cam_world.detach(), front_moved.t_cam_world.detach())
    torch.testing.assert_close(aside_moved.R_cam_world.detach(), expected.R_cam_world, atol=1e-6, rtol=0)
    torch.testing.assert_close(aside_moved.t_cam_world.detach(), expected.t_cam_world, atol=1e-6, rtol=0)
    assert float((front_moved.t_cam_world.detach() - t).abs().max()) > 1e-3


def test_a_correction_turns_the_head_about_its_centre_and_has_no_common_part() -> None:
    centre = torch.tensor([0.01, -0.02, 0.03])
    corrections = PoseCorrections(range(3), centre)
    R, t = torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.01, 0.0, 0.8])
    camera = Camera(R, t, 90.0, 90.0, 16.0, 16.0, 32, 32)

    def pose() -> HeadPose:
        moved = corrections(camera, torch.tensor([2]), corrections.jacobian(camera))
        return HeadPose(moved.R_cam_world.detach(), moved.t_cam_world.detach())

    assert torch.equal(pose().R, R) and torch.equal(pose().t, t)
    with torch.no_grad():
        corrections.moves.copy_(0.1 * torch.arange(15.0).reshape(3, 5))
    own = corrections.moves.detach()[2] - corrections.moves.detach().mean(dim=0)
    units = torch.tensor([TURN_UNIT] * 3 + [SHIFT_UNIT] * 2)
    expected = moved_pose(torch.cat((own * units, torch.zeros(1))), HeadPose(R, t), centre)
    for found in (pose(), pose()):
        torch.testing.assert_close(found.R, expected.R, atol=1e-4, rtol=0.0)  # the square of a hundredth
        torch.testing.assert_close(found.R @ centre + found.t, expected.R @ centre + expected.t, atol=1e-6, rtol=0.0)
        with torch.no_grad():
            corrections.moves += 0.5


def test_a_resumed_run_has_the_same_bits(tracked_folder: Path, tmp_path: Path) -> None:
    train_small(tracked_folder, tmp_path / "whole")
    whole = newest_checkpoint(tmp_path / "whole")
    assert whole.tensors[f"{PREFIX}moves"].any()
    run = tmp_path / "broken"
    train_small(tracked_folder, run)
    for file in list_checkpoints(run / "checkpoints")[1:]:
        file.unlink()
    halfway = newest_checkpoint(run)
    assert halfway.step < whole.step
    train_small(tracked_folder, run, resume=halfway)
    broken = newest_checkpoint(run)
    assert broken.step == whole.step and broken.tensors.keys() == whole.tensors.keys()
    assert all(torch.equal(value, broken.tensors[name]) for name, value in whole.tensors.items())


def test_a_checkpoint_without_them_or_of_other_frames_is_refused(tracked_folder: Path, tmp_path: Path) -> None:
    train_small(tracked_folder, tmp_path / "run", ["trainer.pose_rate=0"])
    tensors = newest_checkpoint(tmp_path / "run").tensors
    assert not [name for name in tensors if "pose_corrections" in name]
    corrections = PoseCorrections(range(4), torch.zeros(3))
    for damaged in (tensors, {f"{PREFIX}moves": torch.zeros(5, 5)}):
        with pytest.raises(UserError, match="pose corrections of 4 training frames"):
            corrections.load(damaged)
    corrections.load({f"{PREFIX}moves": torch.ones(4, 5)})
    assert bool((corrections.moves == 1.0).all())
