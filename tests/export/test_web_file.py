"""What a page's avatar file keeps of its numbers, and what is said of one that a browser draws slowly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avatar.export.web_arrays import reduce_avatar
from avatar.export.web_file import quantised
from avatar.export.web_page import write_page
from avatar.runs.trained_avatar import TrainedAvatar


@pytest.mark.parametrize(("column", "scales"), [("all", 1), ("column", 2), ("last two", 6), ("row", 4)])
def test_quantised_values_are_multiples_of_their_scales(column: str, scales: int) -> None:
    values = np.random.default_rng(0).standard_normal((4, 3, 2)) * (1.0, 50.0)
    integers, found = quantised(values, "i2", column, 32767)
    back = integers * (found[:, None] if column == "row" else found)
    assert found.shape == (scales,) and integers.dtype == np.int16
    np.testing.assert_allclose(back.reshape(values.shape), values, atol=0.5 * found.max())


def test_a_network_that_is_slow_in_a_browser_is_said(
    trained: TrainedAvatar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = reduce_avatar(trained).sizes["nodes"]
    for most in (nodes, nodes - 1):
        monkeypatch.setattr("avatar.export.web_page.SLOW_NODES", most)
        assert (f"{nodes:,} places" in write_page(trained, tmp_path / "a.html").note) == (most < nodes)
