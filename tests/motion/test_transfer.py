from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from heads import grid_head, rest_params

from avatar.head.model import HeadModel, matrix_from_6d
from avatar.motion.expression_space import fit_expressions
from avatar.motion.neutral_pose import RestPose, find_mean, find_neutral
from avatar.motion.statistics import MotionStatistics, learn_statistics
from avatar.motion.transfer import TRANSFERS, retargeted, transfer_motion
from avatar.pose_refinement.tracking_values import rotation
from avatar.types import HeadParams


def rotation_x(degrees: float) -> torch.Tensor:
    c, s = torch.cos(torch.deg2rad(torch.tensor(degrees))), torch.sin(torch.deg2rad(torch.tensor(degrees)))
    return torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]])


def talking(rest: torch.Tensor, jaw_rest: float, frames: int = 100, seed: int = 0) -> list[HeadParams]:
    """A person who is at rest in every other frame and moves one way (jaw down, mouth open) in between."""
    generator = torch.Generator().manual_seed(seed)
    motion = []
    for i in range(frames):
        activity = 0.0 if i % 2 else float(torch.rand((), generator=generator))
        wobble = 0.01 * torch.randn(5, generator=generator)
        expression = rest + wobble + activity * torch.tensor([1.0, 0.5, 0, 0, 0])
        jaw = rotation_x(jaw_rest + 20 * activity)[:2].reshape(6)
        motion.append(
            replace(rest_params(), expression=expression, jaw=jaw, eyelids=torch.rand(2, generator=generator))
        )
    return motion


HEAD = HeadModel(grid_head(), torch.zeros(0))
REST_A, REST_B = torch.tensor([0.4, 0, 0.2, 0, 0]), torch.tensor([0, -0.3, 0, 0.5, 0])


def learned(motion: list[HeadParams]) -> MotionStatistics:
    return learn_statistics(motion, HEAD)


def test_the_neutral_is_found_and_the_mean_is_not_it() -> None:
    motion = talking(REST_A, 3.0)
    neutral, mean = find_neutral(motion, HEAD), find_mean(motion)
    assert (neutral.expression - REST_A).abs().max() < 0.02
    assert (neutral.jaw - rotation_x(3.0)).abs().max() < 0.01
    assert neutral.frame is not None and neutral.frame % 2 == 1
    assert (mean.expression - REST_A).abs().max() > 0.1
    assert learn_statistics(motion, HEAD, mean).neutral is mean


def test_relative_transfer_recovers_the_motion_about_the_targets_own_rest() -> None:
    """The same performance by two people with different rest poses: relative finds it, raw is off by the difference."""
    driver, target = talking(REST_A, 3.0), talking(REST_B, -2.0)
    moved, source, goal = transfer_motion(driver, learned(target), "relative", HEAD)
    assert len(moved) == len(driver) and source is not None and goal is not None
    error = max(float((m.expression - t.expression).abs().max()) for m, t in zip(moved, target, strict=True))
    jaw_error = max(float((m.jaw - t.jaw).abs().max()) for m, t in zip(moved, target, strict=True))
    raw, _, _ = transfer_motion(driver, learned(target), "raw", HEAD)
    raw_error = max(float((m.expression - t.expression).abs().max()) for m, t in zip(raw, target, strict=True))
    assert error < 0.03 and jaw_error < 0.01 and raw_error > 0.4
    assert all(copied is own for copied, own in zip(raw, driver, strict=True))


def test_mean_transfer_moves_mean_to_mean() -> None:
    driver, target = talking(REST_A, 3.0, seed=1), talking(REST_B, -2.0, seed=2)
    moved, _, _ = transfer_motion(driver, learned(target), "mean", HEAD)
    torch.testing.assert_close(find_mean(moved).expression, find_mean(target).expression)
    torch.testing.assert_close(find_mean(moved).jaw, find_mean(target).jaw, rtol=0, atol=1e-5)


@pytest.mark.parametrize("mode", TRANSFERS)
def test_gaze_eyelids_and_the_number_of_frames_are_the_drivers(mode) -> None:
    driver, target = talking(REST_A, 3.0, frames=33), talking(REST_B, -2.0, frames=60)
    moved, _, _ = transfer_motion(driver, learned(target), mode, HEAD)
    assert len(moved) == 33
    for before, after in zip(driver, moved, strict=True):
        assert torch.equal(before.eyelids, after.eyelids) and torch.equal(before.eyes, after.eyes)
        R = matrix_from_6d(after.jaw)
        torch.testing.assert_close(R @ R.T, torch.eye(3), rtol=0, atol=1e-5)


def about(axis: tuple[float, float, float], degrees: float) -> torch.Tensor:
    return rotation(torch.tensor(axis) * math.radians(degrees))


def test_a_jaw_turns_from_the_targets_rest_by_the_drivers_departure() -> None:
    """About other axes than that of the rest, where the order of the turns counts."""
    source = RestPose(torch.zeros(5), about((1, 0, 0), 20.0), None)
    goal = RestPose(torch.zeros(5), about((0, 1, 0), -15.0), None)
    departure = about((0, 0, 1), 12.0)
    driver = replace(rest_params(), jaw=(source.jaw @ departure)[:2].reshape(6))
    (moved,) = retargeted([driver], source, goal, 1.0)
    torch.testing.assert_close(matrix_from_6d(moved.jaw), goal.jaw @ departure, rtol=0, atol=1e-6)
    (half,) = retargeted([driver], source, goal, 0.5)
    expected = goal.jaw @ about((0, 0, 1), 6.0)
    torch.testing.assert_close(matrix_from_6d(half.jaw), expected, rtol=0, atol=1e-6)


def test_transferring_to_oneself_changes_nothing() -> None:
    motion = talking(REST_A, 3.0)
    moved, _, _ = transfer_motion(motion, learned(motion), "relative", HEAD)
    for before, after in zip(motion, moved, strict=True):
        torch.testing.assert_close(after.expression, before.expression)
        torch.testing.assert_close(after.jaw, before.jaw, rtol=0, atol=1e-6)


def test_one_frame_is_enough_and_none_or_another_basis_is_refused() -> None:
    one = talking(REST_A, 0.0, frames=1)
    assert len(transfer_motion(one, learned(one), "relative", HEAD)[0]) == 1
    with pytest.raises(ValueError, match="needs frames of the driver"):
        transfer_motion([], learned(one), "raw", HEAD)
    with pytest.raises(ValueError, match="2 expression coefficients, the target 5"):
        transfer_motion([replace(one[0], expression=torch.zeros(2))], learned(one), "relative", HEAD)


@pytest.mark.parametrize("mode", ["raw", "relative", "mean"])
def test_strength_scales_the_departure_from_rest(mode) -> None:
    driver, target = talking(REST_A, 3.0), talking(REST_B, -2.0)
    still, source, goal = transfer_motion(driver, learned(target), mode, HEAD, strength=0.0)
    full = transfer_motion(driver, learned(target), mode, HEAD).motion
    half = transfer_motion(driver, learned(target), mode, HEAD, strength=0.5).motion
    rest = torch.zeros(5) if goal is None else goal.expression
    rest_jaw = torch.eye(3) if goal is None else goal.jaw
    assert (source is None) == (goal is None) == (mode == "raw")
    for i in range(0, 100, 7):
        torch.testing.assert_close(still[i].expression, rest)
        torch.testing.assert_close(matrix_from_6d(still[i].jaw), rest_jaw, rtol=0, atol=1e-6)
        torch.testing.assert_close(half[i].expression, 0.5 * (rest + full[i].expression))
        # Twice the half turn is the whole one, seen from rest.
        step = rest_jaw.T @ matrix_from_6d(half[i].jaw)
        torch.testing.assert_close(rest_jaw @ step @ step, matrix_from_6d(full[i].jaw), rtol=0, atol=1e-5)


def test_pca_transfer_stays_within_what_the_target_has_shown() -> None:
    """The driver also raises brows and yawns wide; the target has done neither."""
    driver, target = talking(REST_A, 3.0), talking(REST_B, -2.0)
    brows = torch.tensor([0, 0, 0, 0, 2.0])
    wild = [replace(p, expression=p.expression + (brows if i % 10 == 0 else 0)) for i, p in enumerate(driver)]
    wild[0] = replace(wild[0], jaw=rotation_x(60.0)[:2].reshape(6))
    space = fit_expressions(target)
    kept = transfer_motion(wild, learned(target), "pca", HEAD).motion
    free = transfer_motion(wild, learned(target), "relative", HEAD).motion
    assert float(space.distances(free)[::10].min()) > 2.0
    assert float(space.distances(kept).max()) < 1.5
    assert max(float(p.expression[4].abs()) for p in kept) < 0.1, "the driver's is 2, the target only wobbles"
    widest = max(float(matrix_from_6d(p.jaw)[2, 1].asin()) for p in target)
    assert float(matrix_from_6d(kept[0].jaw)[2, 1].asin()) < widest + 0.01
