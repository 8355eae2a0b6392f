from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from avatar.bench import transfer
from avatar.cli import main
from avatar.demo.head import demo_head
from avatar.demo.subject import make_subject, tracking_bias
from avatar.errors import UserError

SMALL = transfer.Scale(size=64, target_frames=24, driver_frames=6, iterations=40)


@pytest.mark.slow
def test_quick_run_prints_a_table_and_writes_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too small to rank the transfers: that takes the usual run."""
    monkeypatch.setattr(transfer, "QUICK", SMALL)
    assert main(["bench", "transfer", "--quick", "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "bench_transfer.json").read_text())
    rows = {row["transfer"]: row for row in written["rows"]}
    assert {row["tracking"] for row in written["rows"]} == {"as given"}
    assert set(rows) == {"raw", "relative", "mean", "pca", "true motion"}
    assert all(row["figures"]["psnr"] > 10.0 for row in rows.values()), "the avatar is not where the truth is"
    printed = capsys.readouterr().out
    assert all(f"{row['figures']['psnr']:.2f}" in printed for row in rows.values())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bench_transfer.json", "bench_transfer.md"], (
        "the scratch folder is gone"
    )


def test_the_bias_is_a_persons_own_and_shape_makes_up_for_most_of_it(tmp_path: Path) -> None:
    head = demo_head()
    for seed in (1, 2):
        bias = tracking_bias(seed, 0.15)
        expression = head.expression_dirs @ bias.expression.numpy()[: head.expression_dirs.shape[2]]
        both = expression + head.identity_dirs @ bias.shape[: head.identity_dirs.shape[2]]
        assert 0 < np.linalg.norm(both) < np.linalg.norm(expression)
    assert not np.allclose(tracking_bias(1, 0.15).expression, tracking_bias(2, 0.15).expression)
    still = tracking_bias(1, 0.0)
    assert not still.expression.any() and not still.shape.any()
    with pytest.raises(UserError, match="neutral_bias must be from 0 to 1"):
        make_subject(tmp_path / "x", 1, 64, neutral_bias=2.0)


@pytest.mark.slow
def test_avatars_of_disturbed_and_refined_tracking_are_driven_too(tmp_path: Path) -> None:
    rows = transfer.measure(SMALL, tmp_path, ["trainer.iterations=10"], full=True)
    by_tracking = {row.tracking: row for row in rows if row.transfer == "relative"}
    assert tuple(by_tracking) == transfer.TRACKINGS
    assert len({row.figures.psnr for row in by_tracking.values()}) == 3
