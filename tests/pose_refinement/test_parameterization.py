"""What may move, how far, and how calmly: from the tracking of the training frames."""

from __future__ import annotations

import math

import pytest
import torch
from drawn_clip import EXPRESSIONS, true_tracks
from poison import poisoned_tracks

from avatar.pose_refinement.parameterization import (
    DEPTH_UNIT,
    FACE_CALM,
    HEAD_CALM,
    HEAD_REACH,
    JITTER_SHARE,
    LEAST_ACCELERATION,
    SHIFT_UNIT,
    SPREAD_SHARE,
    TURN_UNIT,
    find_parameterization,
)
from avatar.pose_refinement.tracking_values import (
    EXPRESSION,
    EYELIDS,
    EYES,
    JAW,
    NECK,
    POSE,
    SHIFT,
    accelerations,
    values_of,
)

CENTRE = torch.zeros(3)
TRAIN = tuple(range(20))


def tracks() -> dict[str, torch.Tensor]:
    made = true_tracks(30)
    made["expression"] = made["expression"].clone()
    made["expression"][:, 4] = 0.3  # never moves
    made["expression"][25, 5] = 9.0  # farther than training has been
    return made


def test_what_never_moves_is_not_free() -> None:
    parameterization = find_parameterization(tracks(), TRAIN, CENTRE)
    free = parameterization.changed()
    assert free[:9].all()  # the head, and its neck although it is at rest
    assert free[JAW].tolist() == [True, False, False]
    assert free[EYES].tolist() == [True, True, False] * 2 and free[EYELIDS].all()
    assert free[EXPRESSION].tolist() == [True] * 4 + [False, True]
    assert torch.equal(parameterization.index, free.nonzero()[:, 0])


def test_units_are_what_trackers_err_by() -> None:
    made = tracks()
    parameterization = find_parameterization(made, TRAIN, CENTRE)
    unit = torch.zeros(20 + EXPRESSIONS).index_put((parameterization.index,), parameterization.unit)
    spread = values_of(made)[:20].std(dim=0, unbiased=False)
    assert torch.allclose(unit[EXPRESSION.start], SPREAD_SHARE * spread[EXPRESSION.start])
    assert unit[3:6].tolist() == pytest.approx([SHIFT_UNIT, SHIFT_UNIT, DEPTH_UNIT])
    assert unit[0] == pytest.approx(TURN_UNIT) and unit[NECK].tolist() == pytest.approx([0.5 * math.pi / 180] * 3)


def test_a_head_that_jitters_may_move_farther() -> None:
    made = true_tracks(400)
    generator = torch.Generator().manual_seed(0)
    made["t"] = made["t"] + torch.tensor([0, 0, 0.002]) * torch.randn(400, 3, generator=generator)
    parameterization = find_parameterization(made, tuple(range(400)), CENTRE)
    assert float(parameterization.unit[5]) == pytest.approx(0.002 / JITTER_SHARE, rel=0.15)
    assert float(parameterization.unit[3]) == pytest.approx(SHIFT_UNIT)


def test_values_stay_where_training_has_been() -> None:
    made = tracks()
    parameterization = find_parameterization(made, TRAIN, CENTRE)
    training = values_of(made)[list(TRAIN)]
    for sign in (1.0, -1.0):
        values = parameterization.all_values(sign * torch.full((30, len(parameterization.index)), 1e3))
        bound = training.amax(dim=0) if sign > 0 else training.amin(dim=0)
        assert torch.equal(values[3, EXPRESSION][:4], bound[EXPRESSION][:4])
        assert float(values[3, JAW.start]) == float(bound[JAW.start])
        assert float(values[3, SHIFT.start]) == pytest.approx(sign * HEAD_REACH * SHIFT_UNIT)
        assert float(values[3, EXPRESSION][4]) == pytest.approx(0.3)
    # What was outside already may stay, and go no farther.
    outside = parameterization.all_values(torch.full((30, len(parameterization.index)), 1e3))[25, EXPRESSION][5]
    assert float(outside) == 9.0


def test_bounds_and_moves_speak_of_the_same() -> None:
    parameterization = find_parameterization(tracks(), TRAIN, CENTRE)
    low, high = parameterization.bounds(7)
    assert bool((low <= 0).all()) and bool((high >= 0).all())
    # float32 has fewer digits for a move in units than for the value: all_values settles the rest
    values = parameterization.values(7, torch.where(torch.isfinite(high), high, 0.0))
    at = parameterization.index[torch.isfinite(high)]
    assert torch.allclose(values[at], parameterization.highest[7][at], atol=1e-6)
    untouched = ~parameterization.changed()
    assert torch.equal(values[untouched], parameterization.given[7][untouched])


def test_the_head_is_calmer_than_the_face() -> None:
    made = tracks()
    parameterization = find_parameterization(made, TRAIN, CENTRE)
    motion = accelerations(made, values_of(made), CENTRE)
    assert torch.equal(parameterization.acceleration, motion[:, parameterization.index] / parameterization.unit)
    typical = (motion[1:19].square().mean(dim=0).sqrt()[parameterization.index] / parameterization.unit).tolist()
    assert float(parameterization.calm[0]) == pytest.approx(HEAD_CALM / typical[0] ** 2, rel=1e-5)
    jaw = int((parameterization.index == JAW.start).nonzero())
    assert float(parameterization.calm[jaw]) == pytest.approx(FACE_CALM / typical[jaw] ** 2, rel=1e-5)
    # the neck is at rest here, and turns with the head
    scale = motion[1:19, 1].square().mean().sqrt() / parameterization.unit[7]
    assert float(parameterization.calm[7]) == pytest.approx(HEAD_CALM / float(scale) ** 2, rel=1e-5)


def test_a_cut_is_no_acceleration() -> None:
    """The head is elsewhere after it."""
    one = true_tracks(40)
    cut = {n: v if n == "shape" else torch.cat((v, v)) for n, v in one.items()}
    cut["t"] = cut["t"] + torch.tensor([0.03, 0.01, 0.05]) * (torch.arange(80) >= 40)[:, None]
    whole = find_parameterization(one, tuple(range(40)), CENTRE)
    numbers = [*range(5, 45), *range(46, 86)]
    parameterization = find_parameterization(cut, tuple(range(80)), CENTRE, numbers)
    torch.testing.assert_close(parameterization.calm, whole.calm, rtol=0.1, atol=0)


def test_held_out_frames_say_nothing_of_what_may_move() -> None:
    made = true_tracks(30)
    parameterization, other = (
        find_parameterization(one, TRAIN, CENTRE) for one in (made, poisoned_tracks(made, range(20, 30)))
    )
    for name in ("index", "unit", "calm"):
        assert torch.equal(getattr(parameterization, name), getattr(other, name)), name
    for name in ("given", "lowest", "highest"):
        assert torch.equal(getattr(parameterization, name)[:20], getattr(other, name)[:20]), name


def test_a_clip_that_stands_still_can_be_refined() -> None:
    made = {name: value[:1].repeat(6, *[1] * (value.ndim - 1)) for name, value in true_tracks(1).items()}
    made["shape"] = torch.zeros(2)
    parameterization = find_parameterization(made, (0, 1, 2), CENTRE)
    assert parameterization.index.tolist() == list(range(9))
    assert torch.isfinite(parameterization.calm).all()
    assert float(parameterization.calm.max()) == pytest.approx(HEAD_CALM / LEAST_ACCELERATION**2)
    assert find_parameterization({n: v[:1] if n != "shape" else v for n, v in made.items()}, (0,), CENTRE).unit.all()


def test_moves_are_centred_without_extremes_and_only_the_head_poses() -> None:
    parameterization = find_parameterization(tracks(), TRAIN, CENTRE)
    frames = torch.arange(30) < 20
    moves = torch.randn(30, len(parameterization.index), generator=torch.Generator().manual_seed(0)) + 3.0
    moves[:2] = 1000.0  # the tracker was lost
    centred = parameterization.centred(moves, frames)
    pose = parameterization.index < POSE.stop
    assert pose.sum() == 6 and torch.equal(centred[:, ~pose], moves[:, ~pose])
    expected = moves[frames].sort(dim=0).values[2:18].mean(dim=0)
    torch.testing.assert_close(moves[:, pose] - centred[:, pose], expected[pose].expand(30, 6), rtol=0, atol=1e-4)
    assert torch.equal(parameterization.centred(moves, torch.zeros(30, dtype=torch.bool)), moves)
