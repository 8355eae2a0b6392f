"""How the splatter's tests draw where Triton interprets the GPU's kernels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from avatar.compute.device import interpreted


@pytest.fixture(autouse=True)
def _wide_steps(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The interpreter takes time for each operation, however many numbers it is about."""
    if not interpreted():
        yield
        return
    from avatar.splat import gpu_draw

    wide = gpu_draw.Tuning(tile=16, step=32, backward_step=32, lanes=1024, backward_lanes=1024)
    monkeypatch.setattr(gpu_draw, "TUNING", wide)
    with np.errstate(all="ignore"):  # lanes that are masked out later may overflow
        yield
