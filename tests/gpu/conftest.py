"""Tests of the GPU's kernels: on a GPU where there is one, else by Triton's interpreter where that is asked for."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from interpreter import REASON, RUNS_KERNELS, quick_interpreter


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[None]:
    if not RUNS_KERNELS and "without_kernels" not in request.keywords:
        pytest.skip(REASON)
    with quick_interpreter(monkeypatch):
        yield
