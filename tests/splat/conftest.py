"""How the splatter's tests draw where Triton interprets the GPU's kernels."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from interpreter import quick_interpreter


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with quick_interpreter(monkeypatch):
        yield
