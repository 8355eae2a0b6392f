"""A whole subject: every frame's tracking moved until the trained avatar's picture of it fits, then smoothed over time.

The avatar stands still; frames are independent until the smoothing, so that they are refined side by side and an
interruption loses a few seconds. What is found does not depend on the number of threads. With several cameras, a frame
here is a row of the tracks: one time, and one move for the pictures of all its cameras.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from avatar.compute.device import on_gpu, to_device
from avatar.compute.interruption import interruption
from avatar.compute.native import thread_count
from avatar.data.split import evenly_spread
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement.descent import Problem, curvature, descend
from avatar.pose_refinement.fitted_pictures import camera_place, fitted_pictures
from avatar.pose_refinement.frame_fitter import FrameFitter, Target, coarse_levels, head_psnr, targets
from avatar.pose_refinement.parallel import each_in_order
from avatar.pose_refinement.parameterization import find_parameterization
from avatar.pose_refinement.progress import read_progress, write_progress
from avatar.pose_refinement.smoothing import smoothed
from avatar.pose_refinement.tracking_values import HeadPose, moved_tracks
from avatar.splat import CannotDraw

COARSE_STEPS, FINE_STEPS = 3, 8
SAMPLES = 6  # training frames whose mean curvature stands for all
SAVE_EVERY = 50  # frames
TIMED_FRAMES = 4  # for an estimate
PROGRESS_FORMAT = 5  # grows with every change of what refinement finds


@dataclass(frozen=True)
class Refined:
    """What became of a subject's T frames; PSNR of the head alone in dB, NaN where a frame shows no head.

    `after` is the fit that the moves were made for, before what the head poses' have in common was taken from them.
    """

    tracks: dict[str, Tensor]  # as `Recording.tracks`
    before: Float[np.ndarray, " T"]
    after: Float[np.ndarray, " T"]
    kept: Bool[np.ndarray, " T"]  # frames that kept their tracking: they fitted no better, or show no head


class _Found(NamedTuple):
    moves: Float[Tensor, " F"]
    figures: tuple[float, float, float]  # misfit and PSNR before, PSNR with the moves; NaN where no head is seen


def refine_subject(
    avatar: Avatar,
    subject: Subject,
    size: int | None,
    background: Float[Tensor, " 3"],
    progress: Path,
    say: Callable[[str], object] = print,
) -> Refined | None:
    """Refine all frames at `size` pixels of width; None after an interruption (Ctrl-C or SIGTERM).

    progress   file for what is done so far: the next call with the same avatar and subject goes on from it. The caller
               removes it when the result is written
    Raises UserError for a frame that cannot be read, when no training frame shows a head and when the disk refuses.
    """
    with frozen(avatar), interruption() as interrupted:
        work = _Work(avatar, subject, size, background)
        key = work.key()
        moves, figures = read_progress(progress, key, len(work.parameterization.index))
        if len(moves):
            say(f"going on after {len(moves)} of {work.count} frames ({progress})")
        matrices = work.curvatures()
        factors = work.factors(matrices)
        todo = range(len(moves), work.count)
        with tqdm(total=work.count, initial=len(moves), desc="refine", unit="frame", dynamic_ncols=True) as bar:
            for found in work.refined(todo, factors):
                moves.append(found.moves)
                figures.append(found.figures)
                bar.update(1)
                if not np.isnan(figures).all():  # none, where no frame so far shows a head
                    bar.set_postfix_str("PSNR {:.2f} -> {:.2f}".format(*np.nanmean(figures, axis=0)[1:]), refresh=False)
                stops = interrupted()  # asked once: what is saved for it is done, too
                if len(moves) % SAVE_EVERY == 0 or stops:
                    write_progress(progress, key, moves, figures)
                if stops:
                    return None
        write_progress(progress, key, moves, figures)
        first = torch.linalg.cholesky(matrices[0])
        result = work.finish(torch.stack(moves), first @ first.T, np.array(figures)[:, :2])
        return None if interrupted() else result


def estimated_seconds(avatar: Avatar, subject: Subject, size: int | None, background: Float[Tensor, " 3"]) -> float:
    """About how long `refine_subject` would take, from a few frames; an avatar that has not been trained will do.

    Raises UserError as `refine_subject`.
    """
    workers = thread_count()
    with frozen(avatar):
        work = _Work(avatar, subject, size, background)
        frames = work.samples(max(TIMED_FRAMES, workers))
        flat = work.factors([torch.eye(len(work.parameterization.index))] * work.levels)
        list(work.refined(work.samples(workers), flat))  # the first gradient loads parts of torch
        begin = time.perf_counter()
        factors = work.factors(work.curvatures(workers))
        middle = time.perf_counter()
        list(work.refined(frames, factors))
        list(work.measured(frames, work.parameterization.given))
        end = time.perf_counter()
    return (middle - begin) * SAMPLES / workers + (end - middle) * work.count / len(frames)


@contextmanager
def frozen(avatar: Avatar) -> Iterator[None]:
    """The parameters ask for no gradients inside, and again what they asked for after."""
    wanted = [parameter.requires_grad for parameter in avatar.parameters()]
    avatar.requires_grad_(False)
    try:
        yield
    finally:
        for parameter, want in zip(avatar.parameters(), wanted, strict=True):
            parameter.requires_grad_(want)


def fingerprint(avatar: Avatar) -> str:
    """SHA-256 of the parameters."""
    digest = hashlib.sha256()
    for name, value in sorted(avatar.state_dict().items()):
        digest.update(f"{name} {list(value.shape)}".encode() + value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


class _Work:
    """An avatar and a subject, with what refining any of its frames needs."""

    def __init__(self, avatar: Avatar, subject: Subject, size: int | None, background: Tensor) -> None:
        self.subject, self.size, self.background = subject, size, background
        self.centre = avatar.head.neutral_vertices().mean(dim=0)
        self.device, self.is_gpu = avatar.device, on_gpu(avatar.quats)
        self.fitter = FrameFitter(avatar, to_device(background, self.device), to_device(self.centre, self.device))
        self.tracks = subject.recording.tracks
        self.train = subject.recording.times(subject.split.train)
        self.pictures = fitted_pictures(subject.recording)
        self.count = len(self.pictures)
        records = subject.manifest.frames
        self.numbers = [records[index].tracking for index in subject.recording.moments(range(len(records)))]
        self.parameterization = find_parameterization(self.tracks, self.train, self.centre, self.numbers)
        self.there = self.parameterization.on(self.device)
        self.levels = coarse_levels(subject.image_size(size)[0])

    def key(self) -> str:
        """Changes with everything that the result depends on."""
        avatar, background = fingerprint(self.fitter.avatar), self.background.tolist()
        choices = (PROGRESS_FORMAT, avatar, self.subject.data_hash, self.size, background, self.numbers)
        return hashlib.sha256(repr(choices).encode()).hexdigest()

    def pose(self, frame: int) -> HeadPose:
        return HeadPose(self.tracks["R"][frame], self.tracks["t"][frame]).on(self.device)

    def targets(self, frame: int, levels: int) -> list[list[Target]] | None:
        """By level, of each picture in which a head is to be seen; None where there is none."""
        by_picture = []
        for index in self.pictures[frame]:
            place = camera_place(self.subject.recording, index)
            made = targets(self.subject.frame(index, self.size), self.background, levels, place)
            if made is not None:
                by_picture.append([target.on(self.device) for target in made])
        return [list(level) for level in zip(*by_picture, strict=True)] or None

    def factors(self, matrices: Sequence[Float[Tensor, "F F"]]) -> list[Float[Tensor, "F F"]]:
        """Lower Cholesky factors, where the avatar is."""
        return [to_device(torch.linalg.cholesky(matrix), self.device) for matrix in matrices]

    def samples(self, count: int) -> list[int]:
        """Training frames, evenly spread; fewer where there are fewer."""
        return evenly_spread(self.train, count)

    def curvatures(self, count: int = SAMPLES) -> list[Float[Tensor, "F F"]]:
        """By level: the mean over a few training frames, with the prior's, which is one."""
        frames = self.samples(count)
        sampled = [found for found in self._of_each(frames, self._curvatures) if found is not None]
        if not sampled:
            raise UserError(
                f"no head is to be seen in the training frames of {self.subject.recording.name}: look at its masks"
            )
        prior = torch.eye(len(self.parameterization.index))
        return [torch.stack(level).mean(dim=0) + prior for level in zip(*sampled, strict=True)]

    def _curvatures(self, frame: int) -> Float[Tensor, "levels F F"] | None:
        made = self.targets(frame, self.levels)
        if made is None:
            return None
        problem = Problem(self.pose(frame), made, frame, self.there)
        return torch.stack([curvature(self.fitter, problem, level) for level in range(self.levels)])

    def _of_each(self, frames: Iterable[int], function: Callable[[int], Tensor | None]) -> Iterator[Tensor | None]:
        """function(frame) in order, on the CPU. Raises UserError for a frame that cannot be drawn."""

        def named(frame: int) -> Tensor | None:
            try:
                return function(frame)
            except CannotDraw as error:
                raise UserError(
                    f"frame {frame} cannot be drawn: {error}; or the avatar's training has gone wrong, train it again"
                ) from error

        return each_in_order(named, frames, on_gpu=self.is_gpu)

    def refined(self, frames: Sequence[int], factors: Sequence[Float[Tensor, "F F"]]) -> Iterator[_Found]:
        """In order. Raises UserError for a frame that cannot be read, or drawn."""
        for frame, found in zip(frames, self._of_each(frames, lambda frame: self.refine(frame, factors)), strict=True):
            if found is None:
                yield _Found(torch.zeros(len(self.parameterization.index)), (np.nan, np.nan, np.nan))
                continue
            if bool(found[-1].isnan()):
                raise UserError(f"frame {frame} cannot be drawn: the avatar's training has gone wrong, train it again")
            misfit, before, after = found[-3:].tolist()
            yield _Found(found[:-3].float(), (misfit, before, after))

    def refine(self, frame: int, factors: Sequence[Float[Tensor, "F F"]]) -> Float[Tensor, " F+3"] | None:
        """One vector where the avatar is, float64: moves, misfit and PSNR before, PSNR after; None where no head is."""
        made = self.targets(frame, self.levels)
        if made is None:
            return None
        problem = Problem(self.pose(frame), made, frame, self.there)
        found = descend(self.fitter, problem, factors, [FINE_STEPS, *[COARSE_STEPS] * (self.levels - 1)])
        before = self.fitter.figures(self.there.given[frame], problem.given, made[0])
        return torch.cat((found.moves.double(), before, head_psnr(found.pictures, made[0])[None]))

    def finish(self, moves: Float[Tensor, "T F"], matrix: Float[Tensor, "F F"], before: np.ndarray) -> Refined:
        """Smooth over time, keep the given tracking of frames that then fit no better than with it, and centre the rest."""
        parameterization = self.parameterization
        numbers = np.array(self.numbers)
        trained_on = torch.zeros(len(moves), dtype=torch.bool)
        trained_on[self.train] = True
        seen = torch.from_numpy(~np.isnan(before[:, 0]))  # others have no moves to tie their neighbours to
        for part in (trained_on & seen, ~trained_on & seen):  # apart: no training frame may follow a held-out one
            given, own_numbers = parameterization.acceleration[part], numbers[part.numpy()]
            moves[part] = smoothed(moves[part], matrix, given, parameterization.calm, own_numbers)
        values = parameterization.all_values(moves)
        after = np.array(list(self.measured(range(len(values)), values)))
        kept = ~(after[:, 0] <= before[:, 0])
        after[kept] = before[kept]
        keep = torch.from_numpy(kept)
        values = parameterization.all_values(parameterization.centred(moves, trained_on & ~keep))
        tracks = moved_tracks(self.tracks, values, parameterization.changed(), self.centre)
        for name, given in self.tracks.items():
            if name != "shape":
                tracks[name] = torch.where(keep.reshape(-1, *[1] * (given.ndim - 1)), given, tracks[name])
        return Refined(tracks, before[:, 1], after[:, 1], kept)

    def measured(self, frames: Sequence[int], values: Float[Tensor, "T P"]) -> Iterator[list[float]]:
        """Misfit and PSNR in order, each frame with its row of `values`; NaN where no head is seen."""
        there = to_device(values, self.device)
        for found in self._of_each(frames, lambda frame: self.measure(frame, there[frame])):
            yield [np.nan, np.nan] if found is None else found.tolist()

    def measure(self, frame: int, values: Float[Tensor, " P"]) -> Float[Tensor, " 2"] | None:
        made = self.targets(frame, 1)
        return None if made is None else self.fitter.figures(values, self.pose(frame), made[0])
