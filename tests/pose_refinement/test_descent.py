"""The curvature that frames share, and the way down of one frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from drawn_clip import BACKGROUND, Clip, drawn_clip, patterned_avatar, screen_errors, wrongly_tracked

from avatar.data.recording import Recording
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement.descent import Problem, curvature, descend
from avatar.pose_refinement.frame_fitter import HUBER_DELTA, FrameFitter, targets
from avatar.pose_refinement.parameterization import find_parameterization
from avatar.pose_refinement.refine_subject import frozen
from avatar.pose_refinement.tracking_values import HeadPose, moved_tracks


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Avatar]:
    avatar = patterned_avatar(tmp_path_factory.mktemp("head"))
    with frozen(avatar):
        yield avatar


@pytest.fixture(scope="module")
def clip(avatar: Avatar) -> Clip:
    return drawn_clip(avatar, frames=10, train=8)


def likeness_of(avatar: Avatar) -> FrameFitter:
    return FrameFitter(avatar, BACKGROUND, avatar.head.neutral_vertices().mean(dim=0))


def problem(clip: Clip, fitter: FrameFitter, frame: int, levels: int = 1) -> Problem:
    tracks = clip.recording.tracks
    made = targets(clip.pictures[frame], BACKGROUND, levels)
    assert made is not None
    given = HeadPose(tracks["R"][frame], tracks["t"][frame])
    return Problem(
        given, [[target] for target in made], frame, find_parameterization(tracks, clip.split.train, fitter.centre)
    )


def factors(clip: Clip, fitter: FrameFitter, levels: int = 1) -> list[torch.Tensor]:
    made = problem(clip, fitter, 0, levels)
    prior = torch.eye(len(made.parameterization.index))
    return [torch.linalg.cholesky(curvature(fitter, made, level) + prior) for level in range(levels)]


def test_where_the_picture_fits_the_curvature_is_the_misfits_own(avatar: Avatar, clip: Clip) -> None:
    fitter = likeness_of(avatar)
    made = problem(clip, fitter, 2)
    matrix = curvature(fitter, made, 0)
    assert torch.allclose(matrix, matrix.T)
    still = torch.zeros(len(made.parameterization.index))

    def misfit(moves: torch.Tensor) -> float:
        return float(fitter.figures(made.parameterization.values(2, moves), made.given, made.targets[0])[0])

    base = misfit(still)
    for k in (2, 3, 4, 8, len(still) - 1):  # the other turns change which splat is in front of which, in jumps
        step = still.clone()
        step[k] = 0.3
        second = (misfit(step) - 2 * base + misfit(-step)) / 0.3**2
        assert float(matrix[k, k]) == pytest.approx(second, rel=0.2, abs=0.05), k
    both, one, other = still.clone(), still.clone(), still.clone()
    both[2], both[3], one[2], other[3] = 0.3, 0.3, 0.3, 0.3
    mixed = (misfit(both) - misfit(one) - misfit(other) + base) / 0.3**2
    assert abs(mixed) > 0.1 * float((matrix[2, 2] * matrix[3, 3]).sqrt())
    assert float(matrix[2, 3]) == pytest.approx(mixed, rel=0.3)


def test_pixels_that_are_far_off_count_less_in_the_curvature(avatar: Avatar, clip: Clip) -> None:
    """By as much as in the Huber loss, whose slope is a quarter of the error there."""
    fitter = likeness_of(avatar)
    made = problem(clip, fitter, 2)
    ((target,),) = made.targets
    still = torch.zeros(len(made.parameterization.index))
    (picture,) = fitter.pictures(made.parameterization.values(2, still), made.given, [target])
    fits, off = (
        replace(made, targets=[[target._replace(picture=picture + error)]]) for error in (0.0, 4 * HUBER_DELTA)
    )
    whole = curvature(fitter, fits, 0)
    torch.testing.assert_close(curvature(fitter, off, 0), 0.25 * whole, rtol=1e-4, atol=1e-4 * float(whole.abs().max()))


@pytest.mark.parametrize("levels", [1, 2])
def test_a_disturbed_frame_comes_back(avatar: Avatar, clip: Clip, levels: int) -> None:
    wrong, fitter = wrongly_tracked(clip, degrees=1.0, mm=2.0), likeness_of(avatar)
    common = factors(wrong, fitter, levels)
    for frame in (1, 9):
        made = problem(wrong, fitter, frame, levels)
        found = descend(fitter, made, common, [6, 3][:levels])
        assert found.pictures[0].shape == made.targets[0][0].picture.shape
        moves = torch.zeros(len(wrong), len(found.moves))
        moves[frame] = found.moves
        before, after = (
            screen_errors(avatar, recording, clip.recording, [frame])
            for recording in (wrong.recording, moved(wrong, made, moves, fitter))
        )
        assert before > 0.25 and after < 0.12 * before


def moved(clip: Clip, made: Problem, moves: torch.Tensor, fitter: FrameFitter) -> Recording:
    parameterization = made.parameterization
    tracks = moved_tracks(
        clip.recording.tracks, parameterization.all_values(moves), parameterization.changed(), fitter.centre
    )
    return replace(clip.recording, tracks=tracks)


def test_the_last_picture_is_that_of_the_moves_and_no_worse_than_the_first(avatar: Avatar, clip: Clip) -> None:
    wrong, fitter = wrongly_tracked(clip), likeness_of(avatar)
    made = problem(wrong, fitter, 4)
    found = descend(fitter, made, factors(wrong, fitter), [2])
    values = made.parameterization.values(4, found.moves)
    assert torch.allclose(found.pictures[0], fitter.pictures(values, made.given, made.targets[0])[0], atol=1e-5)

    def energy(moves: torch.Tensor) -> float:
        misfit = float(fitter.figures(made.parameterization.values(4, moves), made.given, made.targets[0])[0])
        return misfit + 0.5 * float(moves @ moves)

    assert energy(found.moves) < 0.5 * energy(torch.zeros_like(found.moves))
    stuck = descend(fitter, made, [1e-6 * factor for factor in factors(wrong, fitter)], [3])
    # Steps far too long: none is taken.
    assert energy(stuck.moves) <= energy(torch.zeros_like(found.moves)) * (1 + 1e-6)


def test_moves_stay_within_their_bounds(avatar: Avatar, clip: Clip) -> None:
    """A coefficient whose truth lies beyond what training showed goes to the edge of that and no farther."""
    wrong, fitter = wrongly_tracked(clip), likeness_of(avatar)
    tracks = dict(wrong.recording.tracks)
    k = 0
    tracks["expression"] = tracks["expression"].clone()
    tracks["expression"][:, k] = tracks["expression"][:, k].clamp(max=-0.2)
    narrow = replace(wrong, recording=replace(wrong.recording, tracks=tracks))
    truth = clip.recording.tracks["expression"][:, k]
    frame = int(truth.argmax())
    assert float(truth[frame]) > 0.3
    made = problem(narrow, fitter, frame)
    found = descend(fitter, made, factors(narrow, fitter), [8])
    low, high = made.parameterization.bounds(frame)
    assert bool((found.moves >= low).all()) and bool((found.moves <= high).all())
    place = int((made.parameterization.index == 20 + k).nonzero())
    assert float(found.moves[place]) == float(high[place])
