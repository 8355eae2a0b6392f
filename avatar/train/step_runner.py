"""How a training's steps are made: one operation after the other, or on a GPU, after a few, by replaying them.

A step launches a hundred kernels and more, and the host takes several times as long to start them as a GPU to run them. But
they are the same in every step: a CUDA graph holds them, and reads from buffers what differs. Steps in which something else
takes part (LPIPS, whose crop has another size each time; a step that is repeated to say what was wrong) are launched.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import fields, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.compute.cuda_graph import Replay
from avatar.compute.device import on_gpu, to_device
from avatar.gaussians.avatar import Avatar
from avatar.splat.capacity import CAPACITIES, fixed_capacity
from avatar.splat.capacity import Kind as DrawingKind
from avatar.train.align import Alignment, FrameCorrection, StepInput
from avatar.train.condition_noise import ConditionNoise, noisy
from avatar.train.optimizer import schedule, set_rates
from avatar.train.posed_mesh_cache import PosedMeshes
from avatar.train.step import Judge, Objective, Outcome, Weighted, descend, sh_degree, training_step
from avatar.types import Frame, HeadParams

WARM = 3  # steps of a kind that are launched before: they compile, and make what is made once
KEPT = 2  # kinds that are ready at a time; each has memory of its own

_PARAMS = tuple(field.name for field in fields(HeadParams))
_PLANES = ("image", "alpha", "head_mask", "mouth_mask")


class Kind(NamedTuple):
    """Steps that launch the same."""

    size: tuple[int, int]
    sh_degree: int
    term: Weighted | None
    curvature: int | None  # by which of them the frame moves; None: it does not


class CapturedStep(NamedTuple):
    """What replays the steps of a kind: what they saw and, of a frame that moves, its moves."""

    replay: Replay[tuple[Outcome, Tensor | None]]
    capacity: int | None  # pairs that it draws with; None: as many as it takes, which a GPU would have to wait for
    drawing: DrawingKind
    ends: Int[Tensor, " N"]  # of its drawing, see `Capacities.watch`


class StepRunner:
    """Makes the steps of one training."""

    def __init__(
        self,
        avatar: Avatar,
        optimizer: torch.optim.Adam,
        objective: Objective,
        noise: ConditionNoise | None = None,
        alignment: Alignment | None = None,
        say: Callable[[str], object] = print,
    ) -> None:
        self._avatar, self._optimizer, self._objective = avatar, optimizer, objective
        self._noise, self._alignment, self._say = noise, alignment, say
        self._meshes = PosedMeshes(avatar)
        self._replays = on_gpu(avatar.quats) and not avatar.quats.is_meta and avatar.is_fused
        self._launched: Counter[Kind] = Counter()
        self._drawings: dict[Kind, DrawingKind] = {}  # of those that were launched
        self._captured: OrderedDict[Kind, CapturedStep] = OrderedDict()
        self.replayed = 0  # steps so far

    def pose(self, frames: Iterable[Frame]) -> None:
        """Have their meshes ready, as long as there is room."""
        for frame in frames:
            self._meshes.vertices(frame)

    def make(
        self, step: int, frame: Frame, judge: Judge | None, is_nonfinite: Float[Tensor, ""] | None = None
    ) -> Outcome:
        """Step number `step` (from 0) on one frame. See `training_step` for `judge` and what is raised, and
        `Alignment.learn` for `is_nonfinite`. What a replayed step gives is overwritten by the next one."""
        row = None if self._alignment is None else self._alignment.row(step, frame)
        kind = self._kind(step, frame, row)
        if kind is None or judge is None:
            return self._launch(step, frame, row, judge, is_nonfinite)
        captured = self._ready(kind)
        if captured is None and self._launched[kind] >= WARM:
            captured = self._capture(kind, step, frame, row, judge, is_nonfinite)
        if captured is None:
            self._launched[kind] += 1
            outcome = self._launch(step, frame, row, judge, is_nonfinite)
            self._drawings[kind] = CAPACITIES.last_kind
            return outcome
        set_rates(self._optimizer, schedule(step, self._objective.config))
        seen = self._still(step, frame) if row is None else None
        outcome, moves = captured.replay(self._inputs(step, frame, seen, row))
        CAPACITIES.watch(captured.drawing, captured.ends)
        if moves is not None and self._alignment is not None:
            self._alignment.keep(frame.index, moves)
        self.replayed += 1
        return outcome

    def _launch(
        self, step: int, frame: Frame, row: FrameCorrection | None, judge: Judge | None, is_nonfinite: Tensor | None
    ) -> Outcome:
        moving = self._alignment if row is not None else None
        seen = self._still(step, frame) if moving is None or row is None else moving.placed(step, frame, row)
        shown = seen.frame if self._noise is None else self._noise.on(step, seen.frame)
        given = step, shown, seen.vertices, judge, seen.watched
        outcome = training_step(self._avatar, self._optimizer, self._objective, *given)
        if moving is not None:
            moving.learn(seen, is_nonfinite)
        return outcome

    def _still(self, step: int, frame: Frame) -> StepInput:
        if self._alignment is None:
            return StepInput(frame, self._meshes.vertices(frame))
        return self._alignment.still(step, frame)

    def _kind(self, step: int, frame: Frame, row: FrameCorrection | None) -> Kind | None:
        """None: to be launched."""
        if not self._replays:
            return None
        term = self._objective.term(step)
        if term is not None and term.crops:
            return None
        curvature = None if row is None or self._alignment is None else self._alignment.measured
        degree = sh_degree(step)
        return Kind((frame.camera.width, frame.camera.height), degree, term, curvature)

    def _ready(self, kind: Kind) -> CapturedStep | None:
        """A script that has the room that drawings of today need."""
        captured = self._captured.get(kind)
        if captured is None or captured.capacity == CAPACITIES.known(captured.drawing):
            return captured
        del self._captured[kind]
        return None

    def _capture(
        self,
        kind: Kind,
        step: int,
        frame: Frame,
        row: FrameCorrection | None,
        judge: Judge,
        is_nonfinite: Tensor | None,
    ) -> CapturedStep | None:
        """A script of steps like this one, which it does not make; None: it has to be launched."""
        drawing = self._drawings[kind]
        capacity = CAPACITIES.known(drawing)
        if capacity is None and drawing.device.type == "cuda":
            return None
        seen = self._still(step, frame) if row is None else None
        shown = frame if seen is None else seen.frame

        def play(inputs: Sequence[Tensor]) -> tuple[Outcome, Tensor | None]:
            with nullcontext() if capacity is None else fixed_capacity(capacity):
                return self._play(step, shown, row, judge, is_nonfinite, inputs)

        try:
            replay = Replay(play, self._inputs(step, frame, seen, row))
        except RuntimeError as error:
            self._replays = False
            self._say(f"Steps are launched one operation at a time, because they cannot be replayed: {error}")
            return None
        while len(self._captured) >= KEPT:
            self._captured.popitem(last=False)
        self._captured[kind] = CapturedStep(replay, capacity, drawing, CAPACITIES.last_ends)
        return self._captured[kind]

    def _inputs(self, step: int, frame: Frame, seen: StepInput | None, row: FrameCorrection | None) -> list[Tensor]:
        """What differs between steps of a kind, where the avatar is; in the order in which `_play` takes it."""
        from avatar.splat.gpu import pose_on  # imports Triton, which is not there on every machine

        avatar, device = self._avatar, self._avatar.device
        shown = frame if seen is None else seen.frame
        few = [torch.zeros(1) if row is None else torch.tensor([row.rate])]
        few += [] if avatar.turning is None else [avatar.head_rotation(shown.camera.R_cam_world)]
        few += [] if self._noise is None else [self._noise.of(step)]
        inputs = [pose_on(shown.camera, device), to_device(torch.cat(few), device)]
        inputs += [getattr(shown, name) for name in _PLANES]
        if row is not None:
            return inputs + list(row[:-1])
        assert seen is not None
        return [*inputs, seen.vertices, *(getattr(shown.params, name) for name in _PARAMS)]

    def _play(
        self,
        step: int,
        frame: Frame,
        row: FrameCorrection | None,
        judge: Judge,
        is_nonfinite: Tensor | None,
        inputs: Sequence[Tensor],
    ) -> tuple[Outcome, Tensor | None]:
        """Launch a step like number `step` on what `inputs` hold."""
        pose, few, *rest = inputs
        camera = replace(frame.camera, R_cam_world=pose[:9].view(3, 3), t_cam_world=pose[9:])
        frame = replace(frame, camera=camera, **dict(zip(_PLANES, rest, strict=False)))
        rest, rate, few = rest[len(_PLANES) :], few[0], few[1:]
        head_rotation, few = (None, few) if self._avatar.turning is None else (few[:3], few[3:])
        if row is None:
            vertices, *params = rest
            seen = StepInput(replace(frame, params=HeadParams(*params)), vertices)
        else:
            assert self._alignment is not None
            given, lowest, highest, moves, R, t = rest
            seen = self._alignment.placed(step, frame, FrameCorrection(given, lowest, highest, moves, R, t, rate))
        shown = seen.frame if self._noise is None else noisy(seen.frame, few)
        given = step, shown, seen.vertices, judge, seen.watched, head_rotation
        outcome = descend(self._avatar, self._optimizer, self._objective, *given)
        if seen.placed is None or self._alignment is None:
            return outcome, None
        return outcome, self._alignment.moved(seen, is_nonfinite)
