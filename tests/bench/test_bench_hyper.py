from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from avatar.bench.hyper import (
    WAYS,
    Leaves,
    Method,
    by_covariance,
    covariance_leaves,
    fused,
    measure,
    packed_leaves,
    random_heads,
)
from avatar.bench.hyper_report import straight_line
from avatar.cli import main
from avatar.errors import UserError


def test_quick_run_prints_a_table_and_writes_figures_and_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "hyper", "--quick", "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "bench_hyper.json").read_text())
    assert written["machine"]["threads"] == torch.get_num_threads()
    ways = [*WAYS, "covariance"]
    assert [(row["latent_size"], row["way"]) for row in written["rows"]] == [(n, way) for n in (1, 8) for way in ways]
    for row in written["rows"]:
        for part in ("forward", "backward"):
            assert 0 < row[part]["median"] <= row[part]["p95"] and row[part]["repeats"] == 3
        assert row["gaussians"] == 300
        assert (row["floor"] is None) == (row["way"] == "covariance")
        assert row["offsets_error"] <= 1e-5 or row["way"] == "covariance"
    assert (tmp_path / "bench_hyper.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    for way in ways:
        assert sum(line.split()[1:2] == [way] for line in printed.splitlines()) == 2
    assert "ns for each latent dimension" in printed


def off_by_a_little(leaves: Leaves) -> torch.Tensor:
    return fused(leaves) * (1 + 1e-4)


def with_steeper_gradients(leaves: Leaves) -> torch.Tensor:
    offsets = fused(leaves)
    return offsets + 1e-3 * (offsets - offsets.detach())


def not_a_number(leaves: Leaves) -> torch.Tensor:
    return fused(leaves) * torch.nan


@pytest.mark.parametrize("wrong", [off_by_a_little, with_steeper_gradients, not_a_number])
def test_a_wrong_way_is_not_timed(wrong) -> None:
    with pytest.raises(UserError, match="wrong with 3 latent dimensions is wrong, so it is not timed"):
        measure((3,), count=50, repeats=1, ways={"wrong": Method(wrong, packed_leaves)})


def test_the_covariances_are_those_of_the_same_heads() -> None:
    heads = random_heads(20, 6)
    torch.testing.assert_close(
        by_covariance(covariance_leaves(heads)), fused(packed_leaves(heads)), rtol=1e-4, atol=1e-4
    )


def test_a_straight_line_is_found() -> None:
    slope, start, deviation = straight_line({1: 7.0, 2: 9.0, 8: 21.0})
    assert (slope, start, deviation) == pytest.approx((2.0, 5.0, 0.0), abs=1e-9)
    assert straight_line({1: 7.0, 2: 9.0, 8: 42.0})[2] > 0.05
