"""What some training frames say of an avatar in the middle of its training: how it changes with their tracking, and what
their moves have gained."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import on_gpu, to_device
from avatar.data.loader import FrameLoader
from avatar.data.split import evenly_spread
from avatar.data.subject import Subject
from avatar.losses.photometric import MOUTH_WEIGHT
from avatar.pose_refinement.descent import Problem, curvature
from avatar.pose_refinement.frame_fitter import FrameFitter, coarse_levels, head_psnr, resized, targets
from avatar.pose_refinement.motion import HeadPose
from avatar.pose_refinement.parallel import read_later
from avatar.pose_refinement.parameterization import PoseParameterization
from avatar.splat import CannotDraw
from avatar.train.step import stopped
from avatar.types import Frame


@dataclass(frozen=True)
class AlignmentStatistics:
    """Asks evenly spread training frames that show a head; answers are on the CPU."""

    subject: Subject
    size: int | None
    background: Float[Tensor, 3]
    fitter: FrameFitter
    given: HeadPose  # of every frame; where the avatar is, as `parameterization` is
    parameterization: PoseParameterization

    def curvature(
        self, step: int, loader: FrameLoader, moves: Float[Tensor, "T F"], frames: int
    ) -> Float[Tensor, "F F"] | None:
        """The mean curvature of so many frames' misfits, by pictures that are no larger than they need be; None where none
        of them shows a head."""

        def measured(frame: Frame, problem: Problem) -> Tensor:
            coarsest = problem.targets[-1]
            mouth = resized(frame.mouth_mask, coarsest.camera.width, coarsest.camera.height)[coarsest.box]
            weight = to_device(1.0 + MOUTH_WEIGHT * mouth, moves.device)
            return curvature(self.fitter, problem, len(problem.targets) - 1, moves[frame.index], weight)

        found = self._of_frames(step, loader, frames, moves, measured)
        return torch.stack(found).mean(dim=0) if found else None

    def gain(self, step: int, loader: FrameLoader, moves: Float[Tensor, "T F"], frames: int) -> float:
        """What the moves gain on so many frames, dB."""

        def measured(frame: Frame, problem: Problem) -> Tensor:
            target, own = problem.targets[0], moves[frame.index]
            moved, still = (
                head_psnr(
                    self.fitter.picture(problem.parameterization.values(frame.index, at), problem.given, target), target
                )
                for at in (own, torch.zeros_like(own))
            )
            return moved - still

        found = self._of_frames(step, loader, frames, moves, measured)
        return float(torch.stack(found).mean()) if found else 0.0

    def _of_frames(
        self,
        step: int,
        loader: FrameLoader,
        count: int,
        moves: Float[Tensor, "T F"],
        measured: Callable[[Frame, Problem], Tensor],
    ) -> list[Tensor]:
        is_there = on_gpu(moves)
        chosen = evenly_spread(self.subject.split.train, count)
        if is_there:  # the loader's frames are there as well
            frames: Iterable[Frame] = (self.subject.frame(index, self.size) for index in chosen)
        else:
            frames = loader.frames(chosen)

        def begun(frame: Frame) -> Tensor | None:
            made = targets(frame, self.background, coarse_levels(frame.camera.width))
            if made is None:
                return None
            given = HeadPose(frame.camera.R_cam_world, frame.camera.t_cam_world)
            there = [target.on(moves.device, given) for target in made] if is_there else made
            own = HeadPose(*(part[frame.index] for part in self.given))
            problem = Problem(own, there, frame.index, self.parameterization)
            try:
                return measured(frame, problem)
            except CannotDraw as error:
                raise stopped(step, frame, str(error)) from error

        return [found for found in read_later(begun, frames) if found is not None]
