"""How a training's steps are made: one operation after the other, or on a GPU, after a few, by replaying them.

A step launches a hundred kernels and more, and the host takes several times as long to start them as a GPU to run them. But
they are the same in every step: a CUDA graph holds them, and reads from buffers what differs. Steps in which something else
takes part (LPIPS, whose crop has another size each time; a step that is repeated to say what was wrong) are launched.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.cuda_graph import Replay
from avatar.compute.device import on_gpu, to_device
from avatar.compute.gpu_functions import gpu_function
from avatar.train.condition_noise import ConditionNoise
from avatar.train.objective import Weighted, sh_degree
from avatar.train.optimizer import schedule, set_rates
from avatar.train.step import Judge, StepInputs, StepOutputs, TrainState, train_step
from avatar.types import Frame

WARM = 3  # steps of a kind that are launched before: they compile, and make what is made once
MESH_BYTES = 2**28  # of posed meshes, 4,400 frames of FLAME's 5,023 vertices; what does not fit is computed again
KEPT = 2  # kinds that are ready at a time; each has memory of its own


class Kind(NamedTuple):
    """Steps that launch the same."""

    size: tuple[int, int]
    sh_degree: int
    term: Weighted | None


class StepRunner:
    """Makes the steps of one training."""

    def __init__(
        self,
        state: TrainState,
        noise: ConditionNoise | None = None,
        say: Callable[[str], object] = print,
    ) -> None:
        self._state, self._noise, self._say = state, noise, say
        avatar = state.avatar
        self._device = avatar.device
        self._meshes: dict[int, Tensor] = {}  # by time: they do not change while the avatar does
        self._mesh_bytes = MESH_BYTES
        self._jacobians: dict[int, Tensor] = {}  # of the frames' cameras in their corrections
        self._replays = on_gpu(avatar.quats) and not avatar.quats.is_meta and avatar.is_fused
        self._launched: Counter[Kind] = Counter()
        self._captured: OrderedDict[Kind, Replay[StepOutputs]] = OrderedDict()
        self.replayed = 0  # steps so far

    def vertices(self, frame: Frame) -> Float[Tensor, "V 3"]:
        """The posed mesh of the frame's time, metres; kept from its first use on while there is room."""
        mesh = self._meshes.get(frame.time)
        if mesh is None:
            mesh = self._state.avatar.vertices(frame.params)
            if mesh.nbytes <= self._mesh_bytes:
                self._mesh_bytes -= mesh.nbytes
                self._meshes[frame.time] = mesh
        return mesh

    def make(self, step: int, frame: Frame, judge: Judge | None) -> StepOutputs:
        """Step number `step` (from 0) on one frame. See `train_step` for `judge` and what is raised. What a replayed step
        gives is overwritten by the next one."""
        state, config = self._state, self._state.objective.config
        set_rates(state.optimizer, schedule(step, config))
        inputs, kind = self.inputs(step, frame), self._kind(step, frame)
        replay = None if kind is None or judge is None else self._ready(kind, step, inputs, judge)
        if replay is not None:
            self.replayed += 1
            outputs = replay(inputs.tensors())
        else:
            outputs = train_step(state, step, inputs, judge)
            if kind is not None and judge is not None:
                self._launched[kind] += 1
        state.avatar.after_step(state.optimizer, step + 1, config)
        return outputs

    def inputs(self, step: int, frame: Frame) -> StepInputs:
        """What step `step` takes of a frame, where the avatar is."""
        vertices, camera = self.vertices(frame), frame.camera
        noise = None if self._noise is None else to_device(self._noise.of(step), self._device)
        corrections, row, jacobian = self._state.pose_corrections, None, None
        if corrections is not None:
            row = torch.full((1,), corrections.rows[frame.time], device=self._device)
            if frame.index not in self._jacobians:
                self._jacobians[frame.index] = to_device(corrections.jacobian(camera), self._device)
            jacobian = self._jacobians[frame.index]
        if on_gpu(vertices):
            R, t = gpu_function("upload a camera's pose")(camera, self._device).float().split((9, 3))
            turn = None if camera.R_ref_cam is None else to_device(camera.R_ref_cam, self._device)
            camera = replace(camera, R_cam_world=R.view(3, 3), t_cam_world=t, R_ref_cam=turn)
            frame = replace(frame, camera=camera)
        return StepInputs(frame, vertices, noise, row, jacobian)

    def _kind(self, step: int, frame: Frame) -> Kind | None:
        """None: to be launched."""
        term = self._state.objective.term(step)
        if not self._replays or (term is not None and term.crops):
            return None
        return Kind((frame.camera.width, frame.camera.height), sh_degree(step), term)

    def _ready(self, kind: Kind, step: int, inputs: StepInputs, judge: Judge) -> Replay[StepOutputs] | None:
        """What replays steps like this one, captured if need be; None: the step has to be launched."""
        if kind in self._captured or self._launched[kind] < WARM:
            return self._captured.get(kind)

        def play(tensors: Mapping[str, Tensor]) -> StepOutputs:
            return train_step(self._state, step, inputs.with_tensors(tensors), judge)

        try:
            replay = Replay(play, inputs.tensors())
        except RuntimeError as error:
            self._replays = False
            self._say(f"Steps are launched one operation at a time, because they cannot be replayed: {error}")
            return None
        while len(self._captured) >= KEPT:
            self._captured.popitem(last=False)
        self._captured[kind] = replay
        return replay
