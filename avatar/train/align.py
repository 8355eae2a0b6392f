"""Bundle adjustment: training moves the tracking of its own frames towards what the avatar shows.

Where a tracker errs, frames disagree on where a detail lies, and the avatar blurs it to please them all. A step has its
loss's gradient in every Gaussian, and so, for the price of a posed mesh, in the frame's tracking, which takes a share of
the Gauss-Newton step; the curvature is that of refinement (`avatar.tracking`), which all frames share. A prior and bounds
keep the values' meaning. What all frames' head poses have in common is taken out after every pass, because held-out frames
and drivers keep the tracking that they have. Where tracking is sharp there is nothing to gain and noise to catch: then the
given tracking is taken up again.

Left out is how a turn of the head changes the colours that depend on the view: at most 0.24 of the gradient's units, where
it was compared with the whole (docs/best.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import on_gpu
from avatar.config import Config
from avatar.data.loader import FrameLoader
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.model import Avatar
from avatar.splat import CannotDraw
from avatar.tracking.descent import Problem, curvature
from avatar.tracking.freedom import find_freedom
from avatar.tracking.likeness import (
    OBSERVATIONS,
    PIXEL_SIGMA,
    Likeness,
    camera_gradient,
    coarse_levels,
    head_psnr,
    resized,
    targets,
)
from avatar.tracking.motion import HeadPose, head_params, moved_pose, values_of
from avatar.train.order import evenly_spread
from avatar.train.posed import PosedMeshes
from avatar.train.step import Objective, stopped, training_step
from avatar.types import Frame, Gaussians, HeadParams

BEGIN = 0.1  # share of the steps after which the avatar shows enough
AGAIN = 0.35  # after which the curvature, of a sharper avatar, is measured anew, and the gain is judged
END = 0.45  # after which the tracking stays where it is, and posed meshes need not be made again
LAST_RATE = 0.1  # share of the rate that is left then
SAMPLES = 6  # training frames whose mean curvature stands for all
JUDGED = 24  # training frames
LEAST_GAIN = 0.25  # dB of these
MOVING_SHARE = END - BEGIN  # of the steps
# Where refinement moves every frame, and farther than training would; before the user's own overrides.
UNALIGNED = "trainer.align_rate=0"
_PREFIX, _NAMES = "align.", ("moves", "factor", "is_over")  # in a checkpoint


class Placed:
    """A training frame where its tracking has been moved to, for one step."""

    def __init__(self, frame: Frame, values: Float[Tensor, " P"], given: HeadPose, centre: Float[Tensor, 3]) -> None:
        self._values = values.detach().requires_grad_()
        self._pose = moved_pose(self._values, given, centre)
        self._still = HeadPose(self._pose.R.detach(), self._pose.t.detach())
        camera = replace(frame.camera, R_cam_world=self._still.R, t_cam_world=self._still.t)
        self.frame = replace(frame, camera=camera, params=head_params(self._values))
        self._drawn: Gaussians | None = None

    def watched(self, gaussians: Gaussians) -> Gaussians:
        """The same, which keep what drawing them has as gradient."""
        self._drawn = gaussians._replace(means=_watched(gaussians.means), quats=_watched(gaussians.quats))
        return self._drawn

    def gradient(self) -> Float[Tensor, " P"]:
        """Of the loss in the frame's values, once it has been differentiated."""
        drawn, through_face = self._drawn, self._values.grad
        assert drawn is not None and drawn.means.grad is not None and through_face is not None
        by_quats = torch.zeros_like(drawn.quats) if drawn.quats.grad is None else drawn.quats.grad
        by_pose = camera_gradient(drawn, self._still, drawn.means.grad, by_quats)
        (through_pose,) = torch.autograd.grad(tuple(self._pose), self._values, tuple(by_pose))
        return through_face + through_pose


def _watched(values: Tensor) -> Tensor:
    own = values.view_as(values) if values.requires_grad else values.clone().requires_grad_()
    own.retain_grad()
    return own


def make_alignment(
    avatar: Avatar, subject: Subject, config: Config, saved: Mapping[str, Tensor] | None
) -> Alignment | None:
    """For a run that begins, or goes on from the tensors of a checkpoint; None where it moves no tracking.

    On a GPU none does, nor one that began on it. Raises UserError where a GPU is to go on with one that does, and for
    tensors that are not of these frames.
    """
    if config.trainer.align_rate == 0:
        return None
    moves = None if saved is None else saved.get(f"{_PREFIX}moves")
    if on_gpu(avatar.code):
        if moves is not None and bool(moves.any()):
            raise UserError(
                "this run moves its frames' tracking (trainer.align_rate), which a GPU does not yet: add --device cpu"
            )
        return None
    if saved is not None and moves is None:
        return None
    alignment = Alignment(avatar, subject, config)
    if saved is not None:
        alignment.load(saved)
    return alignment


def moving_step(avatar: Avatar, optimizer: torch.optim.Adam, objective: Objective, step: int, frame: Frame) -> None:
    """What step number `step` (from 0) takes where it moves its frame's tracking, for who times it; by nothing."""
    params, given = frame.params, HeadPose(frame.camera.R_cam_world, frame.camera.t_cam_world)
    tracks = {name: getattr(params, name)[None] for name in ("neck", "jaw", "eyes", "eyelids", "expression")}
    values = values_of(tracks | {"t": given.t[None]})[0]
    placed = Placed(frame, values, given, avatar.head.neutral_vertices().mean(dim=0))
    posed = avatar.vertices(placed.frame.params)
    training_step(avatar, optimizer, objective, step, placed.frame, posed, None, placed.watched)
    placed.gradient()


class Seen(NamedTuple):
    """What a step sees."""

    frame: Frame
    vertices: Float[Tensor, "V 3"]
    placed: Placed | None = None  # the frame's tracking may move

    @property
    def watched(self) -> Callable[[Gaussians], Gaussians] | None:
        return None if self.placed is None else self.placed.watched


class Alignment:
    """The moves of a subject's training frames, from the given tracking; on the CPU."""

    def __init__(self, avatar: Avatar, subject: Subject, config: Config) -> None:
        trainer, background = config.trainer, torch.tensor(config.data.background)
        self._rate, self._mouth_weight = trainer.align_rate, trainer.mouth_weight
        self._begin, self._again, self._end = (round(share * trainer.iterations) for share in (BEGIN, AGAIN, END))
        self._train: Sequence[int] = subject.split.train
        self._tracks = subject.recording.tracks
        self._centre = avatar.head.neutral_vertices().mean(dim=0)
        self._freedom = find_freedom(self._tracks, self._train, self._centre)
        self._likeness = Likeness(avatar, background, self._centre)
        self._meshes = PosedMeshes(avatar)
        self._places: dict[int, tuple[HeadPose, HeadParams]] = {}  # of frames that move no more
        self._moves = torch.zeros(len(subject), len(self._freedom.index))
        self._factor: Float[Tensor, "F F"] | None = None  # of the curvature, lower Cholesky; None: nothing moves
        self._is_over = False

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        factor = self._moves.new_zeros(0, 0) if self._factor is None else self._factor
        values = (self._moves.clone(), factor, torch.tensor(float(self._is_over)))
        return {f"{_PREFIX}{name}": value for name, value in zip(_NAMES, values, strict=True)}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `tensors` gave, to the bit. Raises UserError where it is not there, or not of these frames."""
        moves, factor, is_over = (tensors.get(f"{_PREFIX}{name}") for name in _NAMES)
        F = self._moves.shape[1]
        if moves is None or factor is None or is_over is None:
            raise UserError("the checkpoint lacks a part of its frames' moves; training cannot go on from it")
        if moves.shape != self._moves.shape or tuple(factor.shape) not in ((0, 0), (F, F)):
            raise UserError("the checkpoint's moves are not of this subject's frames; training cannot go on from it")
        self._moves = moves.clone()
        self._factor = factor.clone() if len(factor) else None
        self._is_over = bool(is_over)

    def see(self, step: int, frame: Frame, loader: FrameLoader, say: Callable[[str], object]) -> Seen:
        """The frame as step `step` (from 0) sees it; every step has to ask. Raises UserError, naming step and frame, when
        the Gaussians cannot be drawn."""
        self._prepare(step, loader, say)
        if self._factor is None or not bool(frame.head_mask.any()):
            return Seen(frame, self._meshes.vertices(frame))
        if step >= self._end:
            still = self._settled(frame)
            return Seen(still, self._meshes.vertices(still))
        values = self._freedom.values(frame.index, self._moves[frame.index])
        placed = Placed(frame, values, self._given(frame.index), self._centre)
        return Seen(placed.frame, self._likeness.avatar.vertices(placed.frame.params), placed)

    def learn(self, step: int, seen: Seen) -> None:
        """Move the frame by what step `step` (from 0) has found."""
        if seen.placed is None or self._factor is None:
            return
        frame, freedom = seen.frame, self._freedom
        moves = self._moves[frame.index]
        # The loss is a mean over the frame; the misfit counts a number of observations on the head.
        scale = OBSERVATIONS / PIXEL_SIGMA**2 * frame.head_mask.numel() / float(frame.head_mask.sum())
        gradient = scale * seen.placed.gradient()[freedom.index] * freedom.unit + moves
        if not bool(torch.isfinite(gradient).all()):
            return
        way = (step - self._begin) / max(self._end - self._begin, 1)
        direction = torch.cholesky_solve(gradient[:, None], self._factor)[:, 0]
        low, high = freedom.bounds(frame.index)
        moved = moves - self._rate * LAST_RATE**way * direction
        self._moves[frame.index] = torch.minimum(torch.maximum(moved, low), high)

    def _prepare(self, step: int, loader: FrameLoader, say: Callable[[str], object]) -> None:
        if self._is_over or not self._begin <= step <= self._end:
            return
        if step == self._begin:
            self._measure(step, loader)
        elif step == self._again:
            gain = self._gain(step, loader)
            if not gain >= LEAST_GAIN:
                self._is_over, self._factor = True, None
                self._moves.zero_()
                say(f"Training keeps its frames' tracking: it is sharp (moving it gains {max(gain, 0.0):.2f} dB).")
                return
            self._measure(step, loader)
            say(f"Training moves its frames' tracking to where the avatar fits them: {gain:.2f} dB so far.")
        elif step == self._end:
            self._centre_moves()
            self._meshes = PosedMeshes(self._likeness.avatar)  # those of before were of the given tracking
        elif (step - self._begin) % len(self._train) == 0:
            self._centre_moves()

    def _settled(self, frame: Frame) -> Frame:
        """The frame where its tracking was moved to, which is reckoned once."""
        if frame.index not in self._places:
            values = self._freedom.values(frame.index, self._moves[frame.index])
            pose = moved_pose(values, self._given(frame.index), self._centre)
            self._places[frame.index] = pose, head_params(values)
        pose, params = self._places[frame.index]
        return replace(frame, camera=replace(frame.camera, R_cam_world=pose.R, t_cam_world=pose.t), params=params)

    def _given(self, frame: int) -> HeadPose:
        return HeadPose(self._tracks["R"][frame], self._tracks["t"][frame])

    def _centre_moves(self) -> None:
        trained_on = torch.zeros(len(self._moves), dtype=torch.bool)
        trained_on[list(self._train)] = True
        centred = self._freedom.centred(self._moves, trained_on)
        self._moves = torch.where(trained_on[:, None], centred, self._moves)

    def _measure(self, step: int, loader: FrameLoader) -> None:
        """The curvature, of pictures that are no larger than they need be."""

        def measured(frame: Frame, problem: Problem) -> Tensor:
            coarsest = problem.targets[-1]
            mouth = resized(frame.mouth_mask, coarsest.camera.width, coarsest.camera.height)[coarsest.box]
            level, moves = len(problem.targets) - 1, self._moves[frame.index]
            return curvature(self._likeness, problem, level, moves, 1.0 + self._mouth_weight * mouth)

        found = self._of_frames(step, loader, SAMPLES, measured)
        if not found:
            self._is_over = True
            return
        prior = torch.eye(self._moves.shape[1])
        self._factor = torch.linalg.cholesky(torch.stack(found).mean(dim=0) + prior)

    def _gain(self, step: int, loader: FrameLoader) -> float:
        """What the moves gain on training frames, dB."""

        def measured(frame: Frame, problem: Problem) -> Tensor:
            target, moves = problem.targets[0], self._moves[frame.index]
            moved, still = (
                head_psnr(self._likeness.picture(self._freedom.values(frame.index, at), problem.given, target), target)
                for at in (moves, torch.zeros_like(moves))
            )
            return moved - still

        found = self._of_frames(step, loader, JUDGED, measured)
        return float(torch.stack(found).mean()) if found else 0.0

    def _of_frames(
        self, step: int, loader: FrameLoader, count: int, measured: Callable[[Frame, Problem], Tensor]
    ) -> list[Tensor]:
        """Of evenly spread training frames that show a head."""
        found = []
        for frame in loader.frames(evenly_spread(self._train, count)):
            levels = coarse_levels(frame.camera.width)
            if (made := targets(frame, self._likeness.background, levels)) is None:
                continue
            try:
                found.append(measured(frame, Problem(self._given(frame.index), made, frame.index, self._freedom)))
            except CannotDraw as error:
                raise stopped(step, frame, str(error)) from error
        return found
