from __future__ import annotations

import sys

import pytest

from avatar.bench.peak_memory import peak_memory

pytestmark = pytest.mark.slow


@pytest.mark.skipif(sys.platform != "linux", reason="the high-water mark is Linux's")
def test_peak_memory_is_that_of_the_drawing() -> None:
    # A hundred thousand splats have 23.6 MB of gradients alone.
    assert 23.6e6 < peak_memory(100_000, 64) < 400e6
