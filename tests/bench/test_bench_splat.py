"""The benchmark writes what it promises, and never times a wrong result."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from avatar import cli
from avatar.bench import splat as bench
from avatar.bench.machine import available_simd
from avatar.bench.splat import Variant, measure
from avatar.errors import UserError
from avatar.splat.scenes import head_shell
from avatar.types import Rendering

pytestmark = pytest.mark.slow


def test_quick_run_prints_a_table_and_writes_figures_and_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", "splat", "--quick", "--out", str(tmp_path / "out")]) == 0
    written = json.loads((tmp_path / "out" / "bench_splat.json").read_text())
    assert written["machine"]["simd"] == available_simd()
    simd = {row["variant"]["simd"] for row in written["rows"] if row["variant"]["backend"] == "cpu"}
    assert simd == set(available_simd())
    assert [row["accuracy"] for row in written["rows"] if row["variant"]["backend"] == "reference"] == [None]
    cutoffs = {(row["variant"]["alpha_min"], row["variant"]["t_min"]) for row in written["rows"]}
    assert cutoffs == {
        (1 / 255, 1e-4),
        (1e-5, 1e-4),
        (2 / 255, 1e-4),
        (4 / 255, 1e-4),
        (1 / 255, 1e-6),
        (1 / 255, 1e-2),
    }
    for row in written["rows"]:
        for time in row["timing"].values():
            assert 0 < time["median"] <= time["p95"]
        if row["accuracy"]:
            assert row["accuracy"]["rms"] <= row["accuracy"]["image"]
            usual = (row["variant"]["alpha_min"], row["variant"]["t_min"]) == (1 / 255, 1e-4)
            assert (row["accuracy"]["image"] <= 1e-5) == usual  # another cut-off is another image
            assert (row["accuracy"]["gradient"] <= 1e-4) == usual
    assert (tmp_path / "out" / "bench_splat.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out.splitlines()
    lines = [line for line in printed if line.lstrip().startswith(("cpu", "reference"))]
    assert len(lines) == len(written["rows"])


def test_cutoffs_are_named_by_what_they_change() -> None:
    assert Variant("cpu", 200, 32, 1, "").changed == ""
    assert Variant("cpu", 200, 32, 1, "", alpha_min=2 / 255).changed == "alpha 2/255"
    assert Variant("cpu", 200, 32, 1, "", alpha_min=1e-5, t_min=1e-2).changed == "alpha 1e-05, T 1e-02"


def brighter(image: Tensor, alpha: Tensor) -> Rendering:
    return Rendering(image + 2e-5, alpha)


def with_steeper_gradients(image: Tensor, alpha: Tensor) -> Rendering:
    return Rendering(image + 1e-3 * (image - image.detach()), alpha)


def not_a_number(image: Tensor, alpha: Tensor) -> Rendering:
    return Rendering(image * torch.nan, alpha)


@pytest.mark.parametrize("t_min", [1e-4, 1e-2], ids=["usual cut-offs", "own cut-offs"])
@pytest.mark.parametrize("wrong", [brighter, with_steeper_gradients, not_a_number])
def test_a_wrong_variant_is_refused(wrong: Any, t_min: float, monkeypatch: pytest.MonkeyPatch) -> None:
    variant = Variant("cpu", 200, 32, 1, "baseline", t_min=t_min)
    measure([variant], repeats=1, validation_size=32)
    draw = bench.draw
    monkeypatch.setattr(bench, "draw", lambda *arguments: wrong(*draw(*arguments)))
    with pytest.raises(UserError, match="is wrong, so it is not timed"):
        measure([variant], repeats=1, validation_size=32)


def test_the_scene_is_the_same_every_time() -> None:
    assert all(torch.equal(a, b) for a, b in zip(head_shell(100), head_shell(100), strict=True))
