"""The stages of a rendered frame or a training step, timed while the program itself goes through them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import Any
from unittest.mock import patch

from torch import Tensor

from avatar.bench.clock import Time, time_of


class Stopwatch:
    """Milliseconds by stage, of one lap (a frame or a step) after the other. A stage is one function or several.

    Backward, a stage lasts from the gradient of what it gave to that of what it was given.
    """

    def __init__(self) -> None:
        self._laps: list[dict[str, float]] = []
        self._stage, self._begin = "", 0.0  # that is running backward

    def lap(self) -> None:
        self._laps.append({})

    def watching(self, owner: Any, name: str, stage: str) -> AbstractContextManager[Any]:
        """Count the calls of `owner.name` as the stage, as long as the context lasts."""
        function: Callable[..., Any] = getattr(owner, name)

        def timed(*arguments: Any, **named: Any) -> Any:
            self._switch("")
            begin = time.perf_counter()
            result = function(*arguments, **named)
            self._add(stage, begin)
            for tensor in tensors_in(result):
                if tensor.requires_grad:
                    tensor.register_hook(lambda _: self._switch(stage))
            return result

        return patch.object(owner, name, timed)

    def times(self, warm_up: int = 2) -> dict[str, Time]:
        """Of all stages, in the order of a lap, without the first laps."""
        laps = self._laps[warm_up:]
        return {stage: time_of([lap[stage] for lap in laps]) for stage in laps[0]}

    def _switch(self, stage: str) -> None:
        if self._stage:
            self._add(f"{self._stage}, backward", self._begin)
        self._stage, self._begin = stage, time.perf_counter()

    def _add(self, stage: str, begin: float) -> None:
        lap = self._laps[-1]
        lap[stage] = lap.get(stage, 0.0) + 1e3 * (time.perf_counter() - begin)


def tensors_in(result: Any) -> Iterable[Tensor]:
    """A tensor, or those of a tuple."""
    parts = result if isinstance(result, tuple) else (result,)
    return [part for part in parts if isinstance(part, Tensor)]
