"""Bundle adjustment: training moves the tracking of its own frames to where the avatar fits them.

A step has its loss's gradient in every Gaussian, and so, for the price of a posed mesh, in its frame's tracking. With L the
loss and m the frame's moves in units of a tracker's errors,

    m <- m - r A^-1 (s dL/dm + m)

A is the curvature of refinement (`avatar.pose_refinement`), shared by all frames, plus the prior's identity; s turns the
loss into refinement's misfit; the rate r falls from `trainer.align_rate` to LAST_RATE of it. The mean move of the head
poses is subtracted after every pass, because held-out frames and drivers keep their tracking. Where the gain is below
LEAST_GAIN, the given tracking is used again.

Left out is how a rotation of the head changes the colours that depend on the view: at most 0.24 units in six frames, whose
largest components are 3 to 16.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import on_gpu, to_device
from avatar.config import Config
from avatar.data.loader import FrameLoader
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.gaussians.avatar import Avatar
from avatar.pose_refinement.frame_fitter import OBSERVATIONS, PIXEL_SIGMA, FrameFitter
from avatar.pose_refinement.motion import HeadPose, head_params, moved_pose
from avatar.pose_refinement.parameterization import PoseParameterization, find_parameterization
from avatar.train.aligned_frame import AlignedFrame, place
from avatar.train.alignment_statistics import AlignmentStatistics
from avatar.train.posed_mesh_cache import PosedMeshes
from avatar.train.step import sh_degree
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

    Raises UserError for tensors that are not of these frames.
    """
    if config.trainer.align_rate == 0:
        return None
    alignment = Alignment(avatar, subject, config)
    if saved is not None:
        alignment.load(saved)
    return alignment


class FrameCorrection(NamedTuple):
    """What a frame's move in one step is made from, where the avatar is; see `PoseParameterization`."""

    given: Float[Tensor, " P"]
    lowest: Float[Tensor, " P"]
    highest: Float[Tensor, " P"]
    moves: Float[Tensor, " F"]
    R: Float[Tensor, "3 3"]  # of the given head pose
    t: Float[Tensor, 3]
    rate: float | Float[Tensor, ""]


class StepInput(NamedTuple):
    """What a step sees."""

    frame: Frame
    vertices: Float[Tensor, "V 3"]
    placed: AlignedFrame | None = None  # the frame's tracking may move
    row: FrameCorrection | None = None  # from which

    @property
    def watched(self) -> Callable[[Gaussians], Gaussians] | None:
        return None if self.placed is None else self.placed.watched


class Alignment:
    """The moves of a subject's training frames, from the given tracking; where the avatar is."""

    def __init__(self, avatar: Avatar, subject: Subject, config: Config) -> None:
        trainer, device = config.trainer, avatar.device
        self._trainer, self._device = trainer, device
        self._begin = round(BEGIN * trainer.iterations)
        self._again = max(round(AGAIN * trainer.iterations), self._begin + 1)
        self._end = max(round(END * trainer.iterations), self._again + 1)
        self._train: Sequence[int] = subject.split.train
        tracks, centre = subject.recording.tracks, avatar.head.neutral_vertices().mean(dim=0)
        self._given = HeadPose(tracks["R"], tracks["t"])
        self._given_there = self._given.on(device)
        self._parameterization = find_parameterization(tracks, self._train, centre)
        self._freedom_there = self._parameterization.on(device)
        self._centre = centre
        background = torch.tensor(config.data.background)
        self._likeness = FrameFitter(avatar, to_device(background, device), to_device(centre, device))
        there = self._likeness, self._given_there, self._freedom_there
        self._inquiry = AlignmentStatistics(subject, config.data.size, background, *there)
        self._meshes = PosedMeshes(avatar)
        self._places: dict[int, tuple[HeadPose, HeadParams]] = {}  # of frames that move no more
        self._moves = torch.zeros(len(subject.recording), len(self._parameterization.index), device=device)
        self._last_moves: Float[Tensor, "T F"] | None = None  # on the CPU, once they move no more
        self._factor: Float[Tensor, "F F"] | None = None  # of the curvature, lower Cholesky; None: nothing moves
        self._is_over = False
        self.measured = 0  # times that the curvature was

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
    ) -> StepInput:
        """The frame as step `step` (from 0) sees it; every step has to ask.

        `settle` waits for all steps before this one and raises when one was not finite; it is called where what they made
        of the avatar is looked at. Raises UserError, naming step and frame, when the Gaussians cannot be drawn.
        """
        self.prepare(step, loader, say, settle)
        row = self.row(step, frame)
        return self.still(step, frame) if row is None else self.placed(step, frame, row)

    def still(self, step: int, frame: Frame) -> StepInput:
        """A frame that does not move in step `step`."""
        if self._factor is not None and step >= self._end and self._shows_head(frame):
            frame = self._settled(frame)
        return StepInput(frame, self._meshes.vertices(frame))

    def row(self, step: int, frame: Frame) -> FrameCorrection | None:
        """Of a frame that moves in step `step`; None: it does not."""
        if self._factor is None or step >= self._end or not self._shows_head(frame):
            return None
        of = self._freedom_there
        given, lowest, highest, moves, R, t = (
            part[frame.index] for part in (of.given, of.lowest, of.highest, self._moves, *self._given_there)
        )
        way = (step - self._begin) / max(self._end - self._begin, 1)
        return FrameCorrection(given, lowest, highest, moves, R, t, self._trainer.align_rate * LAST_RATE**way)

    def placed(self, step: int, frame: Frame, row: FrameCorrection) -> StepInput:
        """The frame where `row` has it, in a step with the colours of step `step`."""
        degree = sh_degree(step)
        values = self._freedom_of(row).values(0, row.moves)
        placed = place(frame, values, HeadPose(row.R, row.t), self._likeness.centre, degree)
        return StepInput(placed.frame, self._likeness.vertices(placed.frame.params), placed, row)

    def learn(self, seen: StepInput, is_nonfinite: Float[Tensor, ""] | None = None) -> None:
        """Move the frame by what the step that saw it has found, unless that is not finite or `is_nonfinite` is 1."""
        if seen.placed is not None:
            self.keep(seen.frame.index, self.moved(seen, is_nonfinite))

    def keep(self, frame: int, moves: Float[Tensor, " F"]) -> None:
        self._moves[frame] = moves

    def moved(self, seen: StepInput, is_nonfinite: Float[Tensor, ""] | None = None) -> Float[Tensor, " F"]:
        """The frame's moves after a step that saw it; see `learn`."""
        frame, row = seen.frame, seen.row
        assert seen.placed is not None and row is not None and self._factor is not None
        parameterization, moves = self._freedom_of(row), row.moves
        # The loss is a mean over the frame; the misfit counts a number of observations on the head.
        area = frame.head_mask.sum().double()
        scale = OBSERVATIONS / PIXEL_SIGMA**2 * frame.head_mask.numel() / area
        gradient = scale * seen.placed.gradient()[parameterization.index] * parameterization.unit + moves
        direction = torch.cholesky_solve(gradient[:, None], self._factor)[:, 0]
        low, high = parameterization.bounds(0)
        moved = moves - row.rate * direction
        moved = torch.minimum(torch.maximum(moved, low), high)
        is_sound = torch.isfinite(gradient).all()
        if is_nonfinite is not None:
            is_sound = is_sound & (is_nonfinite == 0)
        return torch.where(is_sound, moved, moves)

    def _freedom_of(self, row: FrameCorrection) -> PoseParameterization:
        """Of one frame, number 0."""
        return replace(self._freedom_there, given=row.given[None], lowest=row.lowest[None], highest=row.highest[None])

    def _shows_head(self, frame: Frame) -> bool:
        """On a GPU, which is not asked, true: the gradient of a frame without a head is not finite, and moves nothing."""
        return on_gpu(frame.head_mask) or bool(frame.head_mask.any())

    def prepare(
        self, step: int, loader: FrameLoader, say: Callable[[str], object], settle: Callable[[], object]
    ) -> None:
        """Before step `step`; `settle`: as in `see`."""
        if self._is_over or not self._begin <= step <= self._end:
            return
        if step == self._begin:
            settle()
            self._measure(step, loader)
        elif step == self._again:
            settle()
            gain = self._inquiry.gain(step, loader, self._moves, JUDGED)
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
            values = self._parameterization.values(frame.index, self._last_moves[frame.index])
            given = HeadPose(*(part[frame.index] for part in self._given))
            self._places[frame.index] = moved_pose(values, given, self._centre), head_params(values).to(self._device)
        pose, params = self._places[frame.index]
        return replace(frame, camera=replace(frame.camera, R_cam_world=pose.R, t_cam_world=pose.t), params=params)

    def _centre_moves(self) -> None:
        trained_on = torch.zeros(len(self._moves), dtype=torch.bool)
        trained_on[list(self._train)] = True
        moves = self._moves.cpu()
        centred = self._parameterization.centred(moves, trained_on)
        self._moves = torch.where(trained_on[:, None], centred, moves).to(self._device)

    def _measure(self, step: int, loader: FrameLoader) -> None:
        self.measured += 1
        mean = self._inquiry.curvature(step, loader, self._moves, SAMPLES)
        if mean is None:
            self._is_over = True
            return
        self._factor = torch.linalg.cholesky(mean + torch.eye(len(mean))).to(self._device)  # with the prior's
