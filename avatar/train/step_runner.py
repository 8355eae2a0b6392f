"""How a training's steps are made: one operation after the other, or on a GPU, after a few, by replaying them.

A step launches a hundred kernels and more, and the host takes several times as long to start them as a GPU to run them. But
they are the same in every step: a CUDA graph holds them, and reads from buffers what differs. A step that is repeated to
say what was wrong is launched.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.compute.cuda_graph import Replay, new_pool
from avatar.compute.device import on_gpu, to_device
from avatar.compute.gpu_functions import gpu_function
from avatar.data.frame import Frame
from avatar.losses.photometric import crop_of_few_sizes
from avatar.runs.memory_estimate import MESH_BYTES
from avatar.train.condition_noise import ConditionNoise
from avatar.train.loss import Weighted, sh_degree
from avatar.train.optimizer import schedule, set_rates
from avatar.train.step import GradientCheck, StepInputs, StepOutputs, TrainState, train_step
from avatar.train.zoom import Zoom, zoomed
from avatar.types import Camera

WARM = 3  # steps of a kind that are launched before: they compile, and make what is made once
KEPT = 8  # kinds of each lens that are ready at a time
BLOCK = 64  # steps whose noise comes to a GPU at once


class Kind(NamedTuple):
    """Steps that launch the same."""

    size: tuple[int, int]
    sh_degree: int
    term: Weighted | None
    crop: tuple[int, int] | None  # height and width of what the perceptual term sees
    lens: tuple[float, float, float, float]  # fx, fy, cx, cy: launches hold them as numbers

    @classmethod
    def of(cls, step: int, inputs: StepInputs, term: Weighted | None) -> Kind:
        camera, rows, columns = inputs.frame.camera, inputs.crop_rows, inputs.crop_columns
        crop = None if rows is None or columns is None else (len(rows), len(columns))
        lens = camera.fx, camera.fy, camera.cx, camera.cy
        return cls((camera.width, camera.height), sh_degree(step), term, crop, lens)


class FrameConstants(NamedTuple):
    """What a step takes of a frame that is the same each time, where the avatar is."""

    camera: Camera
    row: Int[Tensor, "1"] | None
    pose_jacobian: Float[Tensor, "5 12"] | None
    crop_rows: Int[Tensor, " h"] | None
    crop_columns: Int[Tensor, " w"] | None


class StepRunner:
    """Makes the steps of one training."""

    def __init__(
        self,
        state: TrainState,
        noise: ConditionNoise | None = None,
        zoom: Zoom | None = None,
        say: Callable[[str], object] = print,
    ) -> None:
        self._state, self._noise, self._zoom, self._say = state, noise, zoom, say
        avatar = state.avatar
        self._device = avatar.device
        self._meshes: dict[int, Tensor] = {}  # by time: they do not change while the avatar does
        self._mesh_bytes = MESH_BYTES
        self._constants: dict[int, FrameConstants] = {}
        self._noises: tuple[int, Tensor] | None = None  # the first step of a block, and what is added in each
        self._replays = on_gpu(avatar.quats) and not avatar.quats.is_meta and avatar.is_replayable and zoom is None
        self._launched: Counter[Kind] = Counter()
        self._captured: OrderedDict[Kind, Replay[StepOutputs]] = OrderedDict()
        self._pool = new_pool(self._device)
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

    def make(self, step: int, frame: Frame, check_gradients: GradientCheck | None) -> StepOutputs:
        """Step number `step` (from 0) on one frame. See `train_step` for `check_gradients` and what is raised. What a
        replayed step gives is overwritten by the next one."""
        state, config = self._state, self._state.objective.config
        set_rates(state.optimizer, schedule(step, config))
        inputs = self.inputs(step, frame)
        kind = Kind.of(step, inputs, state.objective.term(step)) if self._replays else None  # None: to be launched
        replay = None if kind is None or check_gradients is None else self._ready(kind, step, inputs, check_gradients)
        if replay is not None:
            self.replayed += 1
            outputs = replay(inputs.tensors())
        else:
            outputs = train_step(state, step, inputs, check_gradients)
            if kind is not None and check_gradients is not None:
                self._launched[kind] += 1
        state.avatar.after_step(state.optimizer, step + 1, config)
        return outputs

    def inputs(self, step: int, frame: Frame) -> StepInputs:
        """What step `step` takes of a frame, where the avatar is."""
        constants = self._constants.get(frame.index)
        if constants is None:
            constants = self._constants[frame.index] = self._constants_of(frame)
        camera, row, jacobian, *crop = constants
        term = self._state.objective.term(step)
        if term is None or not term.crops:
            crop = [None, None]
        frame = replace(frame, camera=camera)
        if self._zoom is not None:  # the crop moves with the head, and is found where it is used
            frame, crop = zoomed(frame, self._zoom.factor(step)), [None, None]
        avatar, objective = self._state.avatar, self._state.objective
        background = objective.background_of(step) if avatar.has_colours else objective.background
        return StepInputs(frame, self.vertices(frame), background, self._noise_of(step), row, jacobian, *crop)

    def _constants_of(self, frame: Frame) -> FrameConstants:
        camera, corrections, device = frame.camera, self._state.pose_corrections, self._device
        row = jacobian = rows = columns = None
        if corrections is not None:
            row = torch.full((1,), corrections.rows[frame.time], device=device)
            jacobian = to_device(corrections.jacobian(camera), device)
        if on_gpu(self._state.avatar.quats):
            R, t = gpu_function("upload a camera's pose")(camera, device).float().split((9, 3))
            turn = None if camera.R_ref_cam is None else to_device(camera.R_ref_cam, device)
            camera = replace(camera, R_cam_world=R.view(3, 3), t_cam_world=t, R_ref_cam=turn)
            term = self._state.objective.perceptual.term
            if frame.head_box is not None and term is not None and term.crops:
                crop = crop_of_few_sizes(frame.head_box, (camera.height, camera.width))
                rows, columns = (to_device(torch.arange(side.start, side.stop), device) for side in crop)
        return FrameConstants(camera, row, jacobian, rows, columns)

    def _noise_of(self, step: int) -> Float[Tensor, " C"] | None:
        if self._noise is None:
            return None
        if self._device.type == "cpu":
            return self._noise.of(step)
        first = step - step % BLOCK  # whichever step a training begins with
        if self._noises is None or self._noises[0] != first:
            self._noises = first, to_device(self._noise.of_steps(range(first, first + BLOCK)), self._device)
        return self._noises[1][step - first]

    def _ready(
        self, kind: Kind, step: int, inputs: StepInputs, check_gradients: GradientCheck
    ) -> Replay[StepOutputs] | None:
        """What replays steps like this one, captured if need be; None: the step has to be launched."""
        if kind in self._captured:
            self._captured.move_to_end(kind)  # what was used longest ago makes room
            return self._captured[kind]
        if self._launched[kind] < WARM:
            return None

        def play(tensors: Mapping[str, Tensor]) -> StepOutputs:
            return train_step(self._state, step, inputs.with_tensors(tensors), check_gradients)

        try:
            replay = Replay(play, inputs.tensors(), self._pool)
        except RuntimeError as error:
            self._replays = False
            self._say(f"Steps are launched one operation at a time, because they cannot be replayed: {error}")
            return None
        lenses = {known.lens for known in self._launched}
        while len(self._captured) >= KEPT * max(len(lenses), 1):
            self._captured.popitem(last=False)
        self._captured[kind] = replay
        return replay
