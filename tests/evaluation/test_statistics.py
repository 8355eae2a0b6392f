"""Jitter, conditions, intervals and bins against what can be worked out by hand."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from heads import grid_head, random_params, rest_params

from avatar.data.split import Split
from avatar.evaluation.bootstrap import RESAMPLES, BlockBootstrap, block_length
from avatar.evaluation.find_lpips import ChosenLpips
from avatar.evaluation.frame_curves import line
from avatar.evaluation.held_out import View
from avatar.evaluation.jitter import JitterMeter
from avatar.evaluation.measure import Pair
from avatar.evaluation.protocol import choose_protocols
from avatar.evaluation.results import FrameResult, binned, summarise, worst_frames
from avatar.evaluation.training_coverage import Conditions, conditions, expression_distances
from avatar.head.model import HeadModel
from avatar.motion.orbit import seen_from
from avatar.types import Camera


def jitters(
    errors: list[int], times: list[int] | None = None, masks: list[torch.Tensor] | None = None
) -> dict[int, float]:
    """Of pictures whose render differs from the truth by `errors` levels everywhere."""
    meter = JitterMeter()
    for number, error in enumerate(errors):
        truth = torch.full((4, 4, 3), 100 + 7 * number, dtype=torch.uint8)
        pair = Pair((truth.int() + error).to(torch.uint8), truth)
        mask = torch.full((4, 4), 255, dtype=torch.uint8) if masks is None else masks[number]
        meter.add(0, number if times is None else times[number], pair, mask)
    return {time: value for (_, time), value in meter.of.items()}


def test_jitter_is_the_second_difference_of_the_error() -> None:
    assert jitters([5, 5, 5, 5]) == {1: 0.0, 2: 0.0}  # a constant error does not flicker
    assert jitters([0, 3, 6, 9]) == {1: 0.0, 2: 0.0}  # nor one that drifts
    assert jitters([0, 0, 2, 0, 0]) == {1: 2.0, 2: 4.0, 3: 2.0}
    assert jitters([-1, 1, -1]) == {1: 4.0}
    assert jitters([1, 2]) == {}


def test_jitter_needs_three_successive_frames() -> None:
    assert jitters([0, 2, 0, 0, 0], times=[10, 11, 13, 14, 15]) == {14: 0.0}


def test_the_pictures_of_each_camera_follow_each_other() -> None:
    """What two cameras see at the same times has nothing to do with each other."""
    meter = JitterMeter()
    truth, mask = torch.full((4, 4, 3), 100, dtype=torch.uint8), torch.full((4, 4), 255, dtype=torch.uint8)
    for time, errors in enumerate(((0, 5), (0, 6), (2, 5))):
        for camera, error in enumerate(errors):
            meter.add(camera, time, Pair(truth + error, truth), mask)
    assert meter.of == {(0, 1): 2.0, (1, 1): 2.0}


def test_jitter_counts_pixels_that_all_three_masks_hold() -> None:
    masks = [torch.full((4, 4), 255, dtype=torch.uint8) for _ in range(3)]
    masks[1][0] = 0
    assert jitters([-1, 1, -1], masks=masks) == {1: 4.0}
    meter = JitterMeter()
    for number, mask in enumerate(masks):
        render = torch.zeros(4, 4, 3)
        render[:2] = number % 2 / 255.0  # floats: two rows flicker by a level, and one of them is masked in one frame
        meter.add(0, number, Pair(render, torch.zeros(4, 4, 3)), mask)
    assert meter.of[0, 1] == pytest.approx(2.0 / 3.0, rel=1e-6)
    masks[2][:] = 0
    assert math.isnan(jitters([0, 0, 0], masks=masks)[1])


def camera_at(degrees: float) -> Camera:
    """A camera half a metre from the head's origin that looks at it, `degrees` towards the head's own left."""
    angle = math.radians(degrees)
    position = torch.tensor([0.5 * math.sin(angle), 0.1, 0.5 * math.cos(angle)])
    forward = -torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    down = torch.tensor([0.0, -1.0, 0.0])
    rotation = torch.stack((torch.linalg.cross(down, forward), down, forward))
    return Camera(rotation, -rotation @ position, 50.0, 50.0, 32.0, 32.0, 64, 64)


@pytest.mark.parametrize("degrees", [-80.0, -10.0, 0.0, 35.0, 120.0])
def test_yaw_is_the_angle_from_which_the_camera_sees_the_head(degrees: float) -> None:
    assert seen_from(camera_at(degrees)).yaw == pytest.approx(degrees, abs=1e-4)


def test_expression_distance_is_to_the_nearest_training_frame_and_leaves_out_the_neck() -> None:
    head = HeadModel(grid_head(), torch.zeros(3))
    training = [random_params(seed) for seed in range(4)]
    other = random_params(9)
    frames = [training[2], dataclasses.replace(training[1], neck=other.neck), other]
    found = expression_distances(head, frames, training)
    assert found[:2] == pytest.approx([0.0, 0.0], abs=1e-3)
    at_rest = [dataclasses.replace(params, neck=rest_params().neck) for params in (*training, other)]
    shapes = torch.stack([head.vertices(params) for params in at_rest]).double()
    expected = (shapes[:4] - shapes[4]).square().sum(dim=-1).mean(dim=-1).sqrt().min().item() * 1000
    assert found[2] == pytest.approx(expected, rel=1e-4) and expected > 1


def test_conditions_compare_with_training_frames() -> None:
    """The held-out frames are the same as others, and not as those of the training."""
    head, motion = HeadModel(grid_head(), torch.zeros(3)), [random_params(seed) for seed in (0, 1, 2, 3, 3, 2)]
    subject: Any = SimpleNamespace(
        split=Split((0, 1), (2, 3)),
        params=motion.__getitem__,
        motion=lambda indices: [motion[i] for i in indices],
        camera=lambda _: camera_at(20.0),
    )
    found = conditions(head, subject, [4, 5])
    distances = expression_distances(head, motion[4:], motion[:2])
    assert [found[index].expression_distance for index in (4, 5)] == pytest.approx(distances) and min(distances) > 1


def test_blocks_are_a_second_long_where_there_are_frames_enough() -> None:
    assert [block_length(count, 25.0) for count in (500, 100, 40, 4, 1)] == [25, 25, 10, 1, 1]
    assert block_length(500, 0.1) == 1


def test_a_resample_holds_runs_of_frames() -> None:
    """The mean of 0, 1, ..., 11 over blocks of 12 is always theirs; over blocks of 6 two starts of seven decide."""
    values = np.arange(12.0)
    assert BlockBootstrap(12, 12).interval(values) == (5.5, 5.5)
    low, high = BlockBootstrap(12, 6).interval(values) or (0.0, 0.0)
    assert 2.5 <= low < 5.5 < high <= 8.5


def test_intervals_are_those_of_the_normal_distribution_for_independent_frames() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, size=400)
    low, high = BlockBootstrap(400, 1).interval(values) or (0.0, 0.0)
    half = 1.96 * values.std() / 20
    assert low == pytest.approx(values.mean() - half, abs=0.08 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.08 * half)
    assert BlockBootstrap(400, 1).interval(values) == (low, high)  # seeded


def test_blocks_cover_the_mean_of_correlated_frames_where_single_frames_do_not() -> None:
    """Of 200 sequences whose neighbours correlate by 0.9, how many 95% intervals hold the true mean 0."""
    generator = np.random.default_rng(2)
    noise = generator.normal(size=(200, 600))
    sequences = np.zeros_like(noise)
    for t in range(1, 600):
        sequences[:, t] = 0.9 * sequences[:, t - 1] + noise[:, t]
    covered = {}
    for block in (1, 25):
        bootstrap = BlockBootstrap(500, block)
        intervals = [bootstrap.interval(sequence[100:]) for sequence in sequences]
        covered[block] = sum(interval is not None and interval[0] <= 0 <= interval[1] for interval in intervals)
    assert covered[1] < 100 and covered[25] > 170


def test_frames_without_a_figure_are_left_out_of_an_interval() -> None:
    values = np.array([1.0, np.nan, 1.0, np.inf, 1.0, np.nan])
    assert BlockBootstrap(6, 2).interval(values) == (1.0, 1.0)
    assert BlockBootstrap(6, 2).interval(np.array([1.0, *[np.nan] * 5])) is None
    assert BlockBootstrap(6, 1).interval(np.array([1.0, *[np.nan] * 4, 3.0])) == (1.0, 3.0)
    assert RESAMPLES == 2000


def test_intervals_do_not_depend_on_which_camera_comes_first() -> None:
    """Blocks hold what all cameras saw in a second, also where the frames of one camera come after those of another."""
    protocol, noise = choose_protocols(["strict"])[0], np.random.default_rng(0).normal(size=60).cumsum()
    rows = {
        (time, camera): FrameResult(
            60 * camera + time, "", dict.fromkeys(protocol.columns, noise[time] + camera), Conditions(0.0, 0.0)
        )
        for time in range(60)
        for camera in range(3)
    }
    seen = {row.index: View(str(camera), time, "time") for (time, camera), row in rows.items()}
    by_time, by_camera = (
        summarise(protocol, {"tracked": ordered}, ChosenLpips(None, ""), 10.0, seen)["intervals"]["psnr"]
        for ordered in ([*rows.values()], sorted(rows.values(), key=lambda row: row.index))
    )
    assert by_time == by_camera


def test_bins_hold_their_lower_edge() -> None:
    figures = {"psnr": np.array([1.0, 2.0, 4.0, np.nan])}
    parts = binned(np.array([-3.0, 0.0, 5.0, 7.0]), (0.0, 5.0, 9.0), figures)
    assert [(part["from"], part["to"], part["frames"], part["means"]["psnr"]) for part in parts] == [
        (None, 0.0, 1, 1.0),
        (0.0, 5.0, 1, 2.0),
        (5.0, 9.0, 2, 4.0),
    ]


def result(index: int, psnr: float) -> Any:
    return FrameResult(index, f"{index:05d}", {"psnr": psnr}, Conditions(0.0, 0.0))


def test_worst_frames_are_the_worst_ones_neighbours_or_not() -> None:
    results = [result(i, psnr) for i, psnr in enumerate([5.0, 1.0, 1.5, 9.0, math.inf, 2.0, 3.0])]
    assert [worst.index for worst in worst_frames(results)] == [1, 2, 5, 6, 0, 3]
    assert [worst.index for worst in worst_frames([result(i, float(i)) for i in range(30)])] == [*range(8)]


def test_curves_do_not_cross_gaps() -> None:
    x, y = line([result(3, 1.0), result(4, 2.0), result(9, 5.0)], "psnr")
    assert x.tolist()[:2] == [3.0, 4.0] and np.isnan(x[2]) and np.isnan(y[2]) and y.tolist()[3] == 5.0
