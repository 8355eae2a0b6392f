"""Training frames whose tracking is moved while the avatar is trained."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from drawn_clip import BACKGROUND, SIZE, Clip, drawn_clip, patterned_avatar, screen_errors, wrongly_tracked
from small_runs import new_avatar, open_small, small_config, train_small

from avatar.errors import UserError
from avatar.gaussians.avatar import SH_DEGREE, Avatar
from avatar.pose_refinement.frame_fitter import FrameFitter, misfit, targets
from avatar.pose_refinement.motion import HeadPose, moved_tracks
from avatar.pose_refinement.parameterization import find_parameterization
from avatar.pose_refinement.refine import frozen
from avatar.runs.checkpoint import list_checkpoints, newest_checkpoint
from avatar.train import align as align_module
from avatar.train.align import Alignment, make_alignment
from avatar.train.aligned_frame import place
from avatar.train.optimizer import make_optimizer
from avatar.train.step import Objective, choose_perceptual, training_step
from avatar.types import Frame

STEPS = 200


class Pictures:
    """A loader of frames that are in memory."""

    def __init__(self, clip: Clip) -> None:
        self._clip = clip

    def frames(self, indices: Iterable[int]) -> Iterator[Frame]:
        return (self._clip.pictures[index] for index in indices)


@pytest.fixture
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    return patterned_avatar(tmp_path_factory.mktemp("head"))


@pytest.mark.parametrize(("view_dependent", "tolerance"), [(0.0, 1e-3), (1.0, 0.05)])
def test_the_gradient_is_that_of_refinement(avatar: Avatar, view_dependent: float, tolerance: float) -> None:
    """But for what a turn does to colours that depend on the view."""
    clip = wrongly_tracked(drawn_clip(avatar))
    with torch.no_grad():
        avatar.sh_rest.mul_(view_dependent)
    (target,) = targets(clip.pictures[3], BACKGROUND, 1) or ()
    tracks, centre = clip.recording.tracks, avatar.head.neutral_vertices().mean(dim=0)
    given, parameterization = (
        HeadPose(tracks["R"][3], tracks["t"][3]),
        find_parameterization(tracks, clip.split.train, centre),
    )
    values = parameterization.values(3, torch.full((len(parameterization.index),), 0.3))
    placed = place(clip.pictures[3], values, given, centre, SH_DEGREE)
    params = placed.frame.params
    camera = placed.frame.camera
    gaussians = placed.watched(avatar(params, avatar.vertices(params), camera.R_cam_world))
    picture = avatar.draw(gaussians, camera, BACKGROUND, region=target.box).image[target.box]
    misfit(picture, target).backward()
    with frozen(avatar):
        expected = FrameFitter(avatar, BACKGROUND, centre).fit(values, given, target).gradient
    found = placed.gradient()
    assert float((found - expected)[parameterization.index].mul(parameterization.unit).norm()) < tolerance * float(
        expected[parameterization.index].mul(parameterization.unit).norm()
    )


def aligned(avatar: Avatar, clip: Clip) -> tuple[Alignment, Clip, list[str]]:
    """The clip after so many steps of an avatar that stands still, with the tracking that it then has."""
    config = small_config(f"data.size={SIZE}", f"trainer.iterations={STEPS}", "trainer.align_rate=0.5")
    alignment = Alignment(avatar, clip, config)  # type: ignore[arg-type]
    objective = Objective(config.trainer, BACKGROUND, choose_perceptual(config.trainer, lambda _: None))
    optimizer, loader, said = make_optimizer(avatar, config.trainer), Pictures(clip), []
    for group in optimizer.param_groups:
        group["full_lr"] = 0.0
    for step in range(STEPS):
        frame = clip.pictures[clip.split.train[step % len(clip.split.train)]]
        seen = alignment.see(step, frame, loader, said.append)  # type: ignore[arg-type]
        training_step(avatar, optimizer, objective, 2000, seen.frame, seen.vertices, None, seen.watched)
        alignment.learn(seen)
    moves = alignment.tensors()["align.moves"]
    tracks, centre = clip.recording.tracks, avatar.head.neutral_vertices().mean(dim=0)
    parameterization = find_parameterization(tracks, clip.split.train, centre)
    moved = moved_tracks(tracks, parameterization.all_values(moves), parameterization.changed(), centre)
    return alignment, replace(clip, recording=replace(clip.recording, tracks=moved)), said


def test_disturbed_training_frames_come_back_and_others_stay(avatar: Avatar) -> None:
    true = drawn_clip(avatar)
    clip = wrongly_tracked(true, common=False)
    _, found, said = aligned(avatar, clip)
    train, test = list(clip.split.train), list(clip.split.test)
    before = screen_errors(avatar, clip.recording, true.recording, train)
    after = screen_errors(avatar, found.recording, true.recording, train)
    assert after < 0.35 * before
    for name in ("R", "t", "jaw", "expression"):
        torch.testing.assert_close(found.recording.tracks[name][test], clip.recording.tracks[name][test])
    assert len(said) == 1 and "moves its frames' tracking" in said[0]


def test_sharp_tracking_is_kept(avatar: Avatar) -> None:
    clip = drawn_clip(avatar)
    alignment, _, said = aligned(avatar, clip)
    assert len(said) == 1 and "it is sharp" in said[0]
    assert not alignment.tensors()["align.moves"].any()
    seen = alignment.see(STEPS, clip.pictures[0], Pictures(clip), said.append)  # type: ignore[arg-type]
    assert seen.frame is clip.pictures[0] and seen.placed is None


def test_at_the_end_frames_are_seen_where_they_were_moved_to(avatar: Avatar) -> None:
    """But for one that shows no head, which stays."""
    clip = wrongly_tracked(drawn_clip(avatar))
    alignment, found, said = aligned(avatar, clip)
    frame, loader = clip.pictures[2], Pictures(clip)
    for _ in range(2):  # the second time from what is kept
        seen = alignment.see(STEPS, frame, loader, said.append)  # type: ignore[arg-type]
        assert seen.placed is None and not seen.vertices.requires_grad
        torch.testing.assert_close(seen.frame.camera.R_cam_world, found.recording.tracks["R"][2])
        torch.testing.assert_close(seen.frame.camera.t_cam_world, found.recording.tracks["t"][2])
        torch.testing.assert_close(seen.vertices, avatar.head.vertices(found.recording.params(2)))
    hidden = replace(frame, head_mask=torch.zeros_like(frame.head_mask))
    assert alignment.see(STEPS, hidden, loader, said.append).frame is hidden  # type: ignore[arg-type]


def test_head_poses_are_centred(avatar: Avatar) -> None:
    clip = wrongly_tracked(drawn_clip(avatar), common=True)
    alignment, _, _ = aligned(avatar, clip)
    moves = alignment.tensors()["align.moves"]
    assert float(moves[list(clip.split.train), :6].mean(dim=0).abs().max()) < 1e-5
    assert float(moves[:, :6].abs().max()) > 0.1 and not moves[list(clip.split.test)].any()


def test_a_resumed_run_has_the_same_bits(tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(align_module, "LEAST_GAIN", -100.0)
    train_small(tracked_folder, tmp_path / "whole")
    whole = newest_checkpoint(tmp_path / "whole")
    assert whole.tensors["align.moves"].any() and not whole.tensors["align.is_over"].any()
    for left in (1, 2):
        run = tmp_path / f"broken{left}"
        train_small(tracked_folder, run)
        for file in list_checkpoints(run / "checkpoints")[left:]:
            file.unlink()
        halfway = newest_checkpoint(run)
        assert halfway.step == 4 * left
        train_small(tracked_folder, run, resume=halfway)
        broken = newest_checkpoint(run)
        assert broken.step == whole.step and broken.tensors.keys() == whole.tensors.keys()
        assert all(torch.equal(value, broken.tensors[name]) for name, value in whole.tensors.items())


def test_a_checkpoint_of_another_kind(tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One without moves and damaged ones are refused."""
    monkeypatch.setattr(align_module, "LEAST_GAIN", -100.0)
    train_small(tracked_folder, tmp_path / "run", ["trainer.align_rate=0"])
    plain = newest_checkpoint(tmp_path / "run")
    assert not [name for name in plain.tensors if name.startswith("align.")]
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    untrained = new_avatar(assets, subject, config)

    def made(tensors: dict[str, torch.Tensor]) -> Alignment | None:
        return make_alignment(untrained, subject, config, tensors)

    with pytest.raises(UserError, match="lacks a part"):
        made(dict(plain.tensors))
    train_small(tracked_folder, tmp_path / "other")
    whole = dict(newest_checkpoint(tmp_path / "other").tensors)
    alignment = made(whole)
    assert alignment is not None
    assert all(torch.equal(value, whole[name]) for name, value in alignment.tensors().items())
    with pytest.raises(UserError, match="not of this subject's frames"):
        made(whole | {"align.factor": torch.zeros(3, 3)})
    with pytest.raises(UserError, match="lacks a part"):
        made({name: value for name, value in whole.items() if name != "align.is_over"})


def begun(avatar: Avatar, clip: Clip, *overrides: str) -> Alignment:
    """After the first measurement of the curvature; the avatar stands still, and only the frame's Huber loss counts."""
    given = f"data.size={SIZE}", "trainer.iterations=100", "trainer.align_rate=0.5", "trainer.perceptual=none"
    config = small_config(*given, *overrides)
    alignment = Alignment(avatar, clip, config)  # type: ignore[arg-type]
    alignment.see(10, clip.pictures[0], Pictures(clip), print)  # type: ignore[arg-type]
    return alignment


def test_the_rate_of_moves_falls_from_its_first_value_to_a_tenth(avatar: Avatar) -> None:
    clip = wrongly_tracked(drawn_clip(avatar))
    rows = [begun(avatar, clip).row(step, clip.pictures[0]) for step in (10, 20, 30, 44)]
    rates = [float(row.rate) for row in rows if row is not None]
    assert len(rates) == 4 and rates[0] == 0.5
    assert all(later < 0.7 * earlier for earlier, later in itertools.pairwise(rates))
    assert rates[-1] == pytest.approx(0.05, rel=0.1)


def test_a_step_moves_a_frame_by_its_share_of_a_gauss_newton_step(avatar: Avatar) -> None:
    """The loss is a mean over the frame, the curvature that of a head of any size."""
    clip = wrongly_tracked(drawn_clip(avatar), degrees=0.05, mm=0.1, share=0.01)
    with torch.no_grad():
        avatar.sh_rest.zero_()  # colours that do not depend on the view: then the gradient is the whole
    alignment, frame = begun(avatar, clip), clip.pictures[3]
    trainer = small_config("trainer.iterations=100", "trainer.perceptual=none").trainer
    objective = Objective(trainer, BACKGROUND, choose_perceptual(trainer, lambda _: None))
    seen = alignment.see(10, frame, Pictures(clip), print)  # type: ignore[arg-type]
    still = copy.deepcopy(avatar), make_optimizer(avatar, trainer)  # the avatar that is optimised gets no gradient
    training_step(*still, objective, 2000, seen.frame, seen.vertices, None, seen.watched)
    alignment.learn(seen)
    found = alignment.tensors()["align.moves"][3]

    tracks, centre = clip.recording.tracks, avatar.head.neutral_vertices().mean(dim=0)
    given, parameterization = (
        HeadPose(tracks["R"][3], tracks["t"][3]),
        find_parameterization(tracks, clip.split.train, centre),
    )
    (target,) = targets(frame, BACKGROUND, 1) or ()
    with frozen(avatar):
        slope = FrameFitter(avatar, BACKGROUND, centre).fit(parameterization.given[3], given, target).gradient
    whole = torch.cholesky_solve(
        (slope[parameterization.index] * parameterization.unit)[:, None], alignment.tensors()["align.factor"]
    )
    assert float((found + 0.5 * whole[:, 0]).norm()) < 0.02 * float(found.norm()) and float(found.norm()) > 1e-3


def test_moves_stay_within_their_bounds(avatar: Avatar) -> None:
    """A step of any size ends where training has been."""
    clip = wrongly_tracked(drawn_clip(avatar))
    alignment, frame = begun(avatar, clip), clip.pictures[3]
    seen = alignment.see(10, frame, Pictures(clip), print)  # type: ignore[arg-type]
    assert seen.placed is not None
    parameterization = find_parameterization(
        clip.recording.tracks, clip.split.train, avatar.head.neutral_vertices().mean(dim=0)
    )
    slope = torch.where(torch.arange(parameterization.given.shape[1]) % 2 == 0, 1e9, -1e9)
    seen.placed.gradient = lambda: slope  # type: ignore[method-assign]
    alignment.learn(seen)
    moves, (low, high) = alignment.tensors()["align.moves"][3], parameterization.bounds(3)
    assert bool((moves >= low).all()) and bool((moves <= high).all()) and bool(((moves == low) | (moves == high)).all())


def test_mouths_count_in_the_curvature_as_in_the_loss(avatar: Avatar, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = wrongly_tracked(drawn_clip(avatar))
    mouth = torch.zeros(SIZE, SIZE)
    mouth[40:52, 26:46] = 1.0
    clip = replace(clip, pictures=tuple(replace(picture, mouth_mask=mouth) for picture in clip.pictures))

    def curvature(weight: float) -> torch.Tensor:
        monkeypatch.setattr("avatar.train.alignment_statistics.MOUTH_WEIGHT", weight)
        factor = begun(avatar, clip).tensors()["align.factor"]
        return factor @ factor.T

    none, one, forty = (curvature(weight) for weight in (0.0, 1.0, 40.0))
    assert float((one - none).norm()) > 0.01 * float(none.norm())
    torch.testing.assert_close(forty - none, 40.0 * (one - none), rtol=0, atol=2e-3 * float(forty.norm()))


class Waiting(Exception):
    pass


def test_what_was_not_finite_moves_nothing_and_is_waited_for(avatar: Avatar) -> None:
    """A GPU is told of steps after one that has gone wrong; it leaves their frames where they are."""
    clip = wrongly_tracked(drawn_clip(avatar))
    config = small_config(f"data.size={SIZE}", "trainer.iterations=100")
    alignment, loader = Alignment(avatar, clip, config), Pictures(clip)  # type: ignore[arg-type]

    def wait() -> None:
        raise Waiting

    with pytest.raises(Waiting):
        alignment.see(10, clip.pictures[0], loader, print, wait)  # type: ignore[arg-type]
    objective = Objective(config.trainer, BACKGROUND, choose_perceptual(config.trainer, lambda _: None))
    optimizer = make_optimizer(avatar, config.trainer)
    alignment.see(10, clip.pictures[0], loader, print)  # type: ignore[arg-type]

    def moved(is_nonfinite: torch.Tensor | None, factor: float = 1.0) -> bool:
        seen = alignment.see(11, clip.pictures[1], loader, print, wait)  # type: ignore[arg-type]
        training_step(avatar, optimizer, objective, 11, seen.frame, seen.vertices, None, seen.watched)
        assert seen.placed is not None
        gradient = factor * seen.placed.gradient()
        seen.placed.gradient = lambda: gradient  # type: ignore[method-assign]
        before = alignment.tensors()["align.moves"]
        alignment.learn(seen, is_nonfinite)
        return not torch.equal(alignment.tensors()["align.moves"], before)

    assert not moved(torch.ones(()))
    assert not moved(None, math.nan)
    assert moved(torch.zeros(())) and moved(None)
