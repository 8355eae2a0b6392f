"""Training on a GPU, where many steps are queued before the first has ended.

To ask after each step whether it was finite would make the GPU wait for the question. So it answers itself: a step whose
loss or gradient is not finite moves nothing, and neither does any after it. When the host reads of it the parameters are
still those before that step, which can be repeated to find what was wrong.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.losses.metrics import psnr
from avatar.losses.photometric import PhotometricLoss
from avatar.train.log import TrainingLog
from avatar.train.step import GradientCheck, StepOutputs

MOST_AHEAD = 64  # steps


class NonFiniteStep(Exception):
    """Step `step` (from 0) was not finite; nothing has moved since."""

    def __init__(self, step: int) -> None:
        super().__init__(f"step {step}")
        self.step = step


class Guard:
    """Tells the optimizer, on its own device, to leave everything as it is from the first step on that is not finite."""

    def __init__(self, optimizer: torch.optim.Adam, device: torch.device) -> None:
        self._sum = torch.zeros((), device=device)  # of 0 for each step, NaN from the first that is not finite on
        self.is_nonfinite: Float[Tensor, ""] = torch.zeros((), device=device)
        optimizer.found_inf = self.is_nonfinite  # type: ignore[attr-defined]  # of Adam's fused kernel: 1 is to do nothing

    def check_gradients(self, loss: PhotometricLoss, gradients: list[Tensor]) -> None:
        """Before the optimizer's step."""
        norms = torch._foreach_norm(gradients)  # pyright: ignore
        self._sum.add_(torch.stack((*norms, loss.total.detach())).sum(), alpha=0.0)
        torch.ne(self._sum, self._sum, out=self.is_nonfinite)


class Numbers(NamedTuple):
    """The figures of a step; float32."""

    is_nonfinite: float
    total: float
    frame: float
    mouth: float
    perceptual: float
    psnr: float  # counts at the steps only that the curves show


@dataclass
class _Note:
    """The numbers of step `step` (from 1) on their way to the host."""

    step: int
    numbers: Float[Tensor, " 6"]
    arrived: torch.cuda.Event | None  # None: they are there

    def has_arrived(self, wait: bool) -> bool:
        if self.arrived is not None and wait:
            self.arrived.synchronize()
        return self.arrived is None or self.arrived.query()


class SyncStepMonitor:
    """Steps on a CPU: each is checked before it moves anything, and logged when it is made."""

    def __init__(self, log: TrainingLog) -> None:
        self._log = log

    check_gradients = None  # `train_step` checks each step itself

    def note(self, step: int, outcome: StepOutputs) -> None:
        self._log.step(step, outcome.loss, outcome.render, outcome.target)

    def flush(self) -> None:
        """Everything is known."""


class AsyncStepMonitor:
    """Steps on a GPU, which run ahead of what the log shows of them."""

    def __init__(self, log: TrainingLog, optimizer: torch.optim.Adam, device: torch.device) -> None:
        self._log, self._guard = log, Guard(optimizer, device)
        self._notes: deque[_Note] = deque()
        self.check_gradients: GradientCheck = self._guard.check_gradients

    @torch.no_grad()
    def note(self, step: int, outcome: StepOutputs) -> None:
        """Send the numbers of a step (from 1) on their way, and log those that have arrived. Raises NonFiniteStep."""
        total = outcome.loss.total.detach()
        quality = psnr(outcome.render, outcome.target).float() if self._log.shows(step) else total
        terms = [term.detach() for term in outcome.loss]
        numbers = torch.stack((self._guard.is_nonfinite, *terms, quality))
        copy, arrived = numbers.to("cpu", non_blocking=True), None
        if numbers.is_cuda:
            arrived = torch.cuda.Event()
            arrived.record()
        self._notes.append(_Note(step, copy, arrived))
        self._read(most_left=MOST_AHEAD)

    def flush(self) -> None:
        """Wait for all that is known of the steps so far. Raises NonFiniteStep."""
        self._read(most_left=0)

    def _read(self, most_left: int) -> None:
        while self._notes and self._notes[0].has_arrived(wait=len(self._notes) > most_left):
            note = self._notes.popleft()
            numbers = Numbers(*note.numbers.tolist())
            if numbers.is_nonfinite:
                raise NonFiniteStep(note.step - 1)
            terms = {name: getattr(numbers, name) for name in PhotometricLoss._fields}
            self._log.note(note.step, numbers.total, terms, numbers.psnr)
