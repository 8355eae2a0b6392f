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

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import brought, on_gpu
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
    coarse_levels,
    head_psnr,
    resized,
    targets,
)
from avatar.tracking.motion import HeadPose, head_params, moved_pose
from avatar.tracking.parallel import read_later
from avatar.train.order import evenly_spread
from avatar.train.placed import Placed, place
from avatar.train.posed import PosedMeshes
from avatar.train.step import sh_degree, stopped
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
WITH_REFINEMENT = ("trainer.align_rate=0", "trainer.condition_noise=0")
_PREFIX, _NAMES = "align.", ("moves", "factor", "is_over")  # in a checkpoint


def make_alignment(
    avatar: Avatar, subject: Subject, config: Config, saved: Mapping[str, Tensor] | None
) -> Alignment | None:
    """For a run that begins, or goes on from the tensors of a checkpoint; None where it moves no tracking.

    Neither does one whose checkpoint knows of no moves: an earlier version began it, on a GPU. Raises UserError for tensors
    that are not of these frames.
    """
    if config.trainer.align_rate == 0 or (saved is not None and f"{_PREFIX}moves" not in saved):
        return None
    alignment = Alignment(avatar, subject, config)
    if saved is not None:
        alignment.load(saved)
    return alignment


class Seen(NamedTuple):
    """What a step sees."""

    frame: Frame
    vertices: Float[Tensor, "V 3"]
    placed: Placed | None = None  # the frame's tracking may move

    @property
    def watched(self) -> Callable[[Gaussians], Gaussians] | None:
        return None if self.placed is None else self.placed.watched


class Alignment:
    """The moves of a subject's training frames, from the given tracking; where the avatar is."""

    def __init__(self, avatar: Avatar, subject: Subject, config: Config) -> None:
        trainer, device = config.trainer, avatar.code.device
        self._trainer, self._size, self._subject, self._device = trainer, config.data.size, subject, device
        self._begin = round(BEGIN * trainer.iterations)
        self._again = max(round(AGAIN * trainer.iterations), self._begin + 1)
        self._end = max(round(END * trainer.iterations), self._again + 1)
        self._train: Sequence[int] = subject.split.train
        tracks, centre = subject.recording.tracks, avatar.head.neutral_vertices().mean(dim=0)
        self._given = HeadPose(tracks["R"], tracks["t"])
        self._given_there = self._given.on(device)
        self._freedom = find_freedom(tracks, self._train, centre)
        self._freedom_there = self._freedom.on(device)
        self._centre = centre
        self._background = torch.tensor(config.data.background)
        self._likeness = Likeness(avatar, brought(self._background, device), brought(centre, device))
        self._meshes = PosedMeshes(avatar)
        self._places: dict[int, tuple[HeadPose, HeadParams]] = {}  # of frames that move no more
        self._moves = torch.zeros(len(subject.recording), len(self._freedom.index), device=device)
        self._last_moves: Float[Tensor, "T F"] | None = None  # on the CPU, once they move no more
        self._factor: Float[Tensor, "F F"] | None = None  # of the curvature, lower Cholesky; None: nothing moves
        self._is_over = False

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        factor = self._moves.new_zeros(0, 0) if self._factor is None else self._factor
        values = (self._moves.clone(), factor, torch.tensor(float(self._is_over)))
        return {f"{_PREFIX}{name}": value.cpu() for name, value in zip(_NAMES, values, strict=True)}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `tensors` gave, to the bit. Raises UserError where it is not there, or not of these frames."""
        moves, factor, is_over = (tensors.get(f"{_PREFIX}{name}") for name in _NAMES)
        F = self._moves.shape[1]
        if moves is None or factor is None or is_over is None:
            raise UserError("the checkpoint lacks a part of its frames' moves; training cannot go on from it")
        if moves.shape != self._moves.shape or tuple(factor.shape) not in ((0, 0), (F, F)):
            raise UserError("the checkpoint's moves are not of this subject's frames; training cannot go on from it")
        self._moves = moves.clone().to(self._device)
        self._factor = factor.clone().to(self._device) if len(factor) else None
        self._is_over = bool(is_over)

    def see(
        self,
        step: int,
        frame: Frame,
        loader: FrameLoader,
        say: Callable[[str], object],
        settle: Callable[[], object] = lambda: None,
    ) -> Seen:
        """The frame as step `step` (from 0) sees it; every step has to ask.

        `settle` waits for all steps before this one and raises when one was not finite; it is called where what they made
        of the avatar is looked at. Raises UserError, naming step and frame, when the Gaussians cannot be drawn.
        """
        self._prepare(step, loader, say, settle)
        if self._factor is None or not self._shows_head(frame):
            return Seen(frame, self._meshes.vertices(frame))
        if step >= self._end:
            still = self._settled(frame)
            return Seen(still, self._meshes.vertices(still))
        values = self._freedom_there.values(frame.index, self._moves[frame.index])
        degree = sh_degree(step, self._trainer, self._likeness.avatar.config.sh_degree)
        placed = place(frame, values, self._given_of(frame.index), self._likeness.centre, degree)
        return Seen(placed.frame, self._likeness.vertices(placed.frame.params), placed)

    def learn(self, step: int, seen: Seen, is_spoilt: Float[Tensor, ""] | None = None) -> None:
        """Move the frame by what step `step` (from 0) has found, unless that is not finite or `is_spoilt` is 1."""
        if seen.placed is None or self._factor is None:
            return
        frame, freedom = seen.frame, self._freedom_there
        moves = self._moves[frame.index]
        # The loss is a mean over the frame; the misfit counts a number of observations on the head.
        area = frame.head_mask.sum().double()
        scale = OBSERVATIONS / PIXEL_SIGMA**2 * frame.head_mask.numel() / area
        gradient = scale * seen.placed.gradient()[freedom.index] * freedom.unit + moves
        way = (step - self._begin) / max(self._end - self._begin, 1)
        direction = torch.cholesky_solve(gradient[:, None], self._factor)[:, 0]
        low, high = freedom.bounds(frame.index)
        moved = moves - self._trainer.align_rate * LAST_RATE**way * direction
        moved = torch.minimum(torch.maximum(moved, low), high)
        is_sound = torch.isfinite(gradient).all()
        if is_spoilt is not None:
            is_sound = is_sound & (is_spoilt == 0)
        self._moves[frame.index] = torch.where(is_sound, moved, moves)

    def _shows_head(self, frame: Frame) -> bool:
        """On a GPU, which is not asked, true: the gradient of a frame without a head is not finite, and moves nothing."""
        return on_gpu(frame.head_mask) or bool(frame.head_mask.any())

    def _prepare(
        self, step: int, loader: FrameLoader, say: Callable[[str], object], settle: Callable[[], object]
    ) -> None:
        if self._is_over or not self._begin <= step <= self._end:
            return
        if step == self._begin:
            settle()
            self._measure(step, loader)
        elif step == self._again:
            settle()
            gain = self._gain(step, loader)
            if not gain >= LEAST_GAIN:
                self._is_over, self._factor = True, None
                self._moves.zero_()
                say(f"Training keeps its frames' tracking: it is sharp (moving it gains {max(gain, 0.0):.2f} dB).")
                return
            self._measure(step, loader)
            say(f"Training moves its frames' tracking to where the avatar fits them: {gain:.2f} dB so far.")
        elif step == self._end:
            settle()
            self._centre_moves()
            self._meshes = PosedMeshes(self._likeness.avatar)  # those of before were of the given tracking
        elif (step - self._begin) % len(self._train) == 0:
            settle()
            self._centre_moves()

    def _settled(self, frame: Frame) -> Frame:
        """The frame where its tracking was moved to, which is reckoned once."""
        if self._last_moves is None:
            self._last_moves = self._moves.cpu()
        if frame.index not in self._places:
            values = self._freedom.values(frame.index, self._last_moves[frame.index])
            given = HeadPose(*(part[frame.index] for part in self._given))
            self._places[frame.index] = moved_pose(values, given, self._centre), head_params(values).to(self._device)
        pose, params = self._places[frame.index]
        return replace(frame, camera=replace(frame.camera, R_cam_world=pose.R, t_cam_world=pose.t), params=params)

    def _given_of(self, frame: int) -> HeadPose:
        """Where the avatar is."""
        return HeadPose(*(part[frame] for part in self._given_there))

    def _centre_moves(self) -> None:
        trained_on = torch.zeros(len(self._moves), dtype=torch.bool)
        trained_on[list(self._train)] = True
        moves = self._moves.cpu()
        centred = self._freedom.centred(moves, trained_on)
        self._moves = torch.where(trained_on[:, None], centred, moves).to(self._device)

    def _measure(self, step: int, loader: FrameLoader) -> None:
        """The curvature, of pictures that are no larger than they need be."""

        def measured(frame: Frame, problem: Problem) -> Tensor:
            coarsest = problem.targets[-1]
            mouth = resized(frame.mouth_mask, coarsest.camera.width, coarsest.camera.height)[coarsest.box]
            weight = brought(1.0 + self._trainer.mouth_weight * mouth, self._device)
            return curvature(self._likeness, problem, len(problem.targets) - 1, self._moves[frame.index], weight)

        found = self._of_frames(step, loader, SAMPLES, measured)
        if not found:
            self._is_over = True
            return
        prior = torch.eye(self._moves.shape[1])
        self._factor = torch.linalg.cholesky(torch.stack(found).mean(dim=0) + prior).to(self._device)

    def _gain(self, step: int, loader: FrameLoader) -> float:
        """What the moves gain on training frames, dB."""

        def measured(frame: Frame, problem: Problem) -> Tensor:
            target, moves = problem.targets[0], self._moves[frame.index]
            moved, still = (
                head_psnr(
                    self._likeness.picture(problem.freedom.values(frame.index, at), problem.given, target), target
                )
                for at in (moves, torch.zeros_like(moves))
            )
            return moved - still

        found = self._of_frames(step, loader, JUDGED, measured)
        return float(torch.stack(found).mean()) if found else 0.0

    def _of_frames(
        self, step: int, loader: FrameLoader, count: int, measured: Callable[[Frame, Problem], Tensor]
    ) -> list[Tensor]:
        """Of evenly spread training frames that show a head, on the CPU."""
        chosen = evenly_spread(self._train, count)
        if on_gpu(self._moves):  # whose loader's frames are there
            frames: Iterable[Frame] = (self._subject.frame(index, self._size) for index in chosen)
        else:
            frames = loader.frames(chosen)

        def begun(frame: Frame) -> Tensor | None:
            made = targets(frame, self._background, coarse_levels(frame.camera.width))
            if made is None:
                return None
            given = HeadPose(frame.camera.R_cam_world, frame.camera.t_cam_world)
            there = [target.on(self._device, given) for target in made] if on_gpu(self._moves) else made
            problem = Problem(self._given_of(frame.index), there, frame.index, self._freedom_there)
            try:
                return measured(frame, problem)
            except CannotDraw as error:
                raise stopped(step, frame, str(error)) from error

        return [found for found in read_later(begun, frames) if found is not None]
