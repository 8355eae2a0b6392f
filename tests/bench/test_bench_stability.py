"""The inverse-covariance trick holds in float32 at any condition number; the direct form does not."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import pytest
import torch

from avatar import cli
from avatar.bench.stability import FORMS, Row, by_covariance, by_precision, fails_at, measure, random_factor


@pytest.mark.parametrize("latent", [1, 8, 128])
def test_the_trick_in_float32_is_exact_up_to_a_condition_number_of_1e12(latent: int) -> None:
    rows = measure([latent], [1.0, 1e6, 1e12], count=40)
    trick = [row for row in rows if row.form == "trick float32"]
    assert len(trick) == 3
    assert all(row.median < 3e-7 and row.worst < 2e-5 for row in trick)


def test_the_direct_form_in_float32_fails_where_float64_does_not() -> None:
    rows = measure([8, 32], [1.0, 1e3, 1e7, 1e9, 1e12], count=40)
    assert fails_at(rows, "direct float32", 8) == 1e9
    assert fails_at(rows, "direct float32", 32) == 1e7
    assert fails_at(rows, "direct float64", 32) is None
    assert all(row.median < 1e-4 for row in rows if row.form == "direct float32" and row.condition <= 1e3)


@pytest.mark.parametrize("condition", [1.0, 1e4, 1e12])
def test_the_factors_have_the_condition_number_asked_for(condition: float) -> None:
    L = random_factor(5, 11, condition, torch.Generator().manual_seed(0))
    found = torch.linalg.cond(L).square()  # of L L^T; squaring L first would lose it
    assert torch.equal(L, L.tril())
    torch.testing.assert_close(found, torch.full_like(found, condition), rtol=1e-3, atol=0)


def test_both_forms_in_float64_are_the_mean_in_exact_arithmetic() -> None:
    """One attribute, two latents: E[a | b] = -L11^-1 L21^T b, and S_ab S_bb^-1 b with S = (L L^T)^-1, in fractions."""
    L = random_factor(1, 3, 1e6, torch.Generator().manual_seed(0))
    latent = torch.tensor([[0.75, -1.5]], dtype=torch.float64)
    rows = [[Fraction(value) for value in row] for row in L[0].tolist()]
    b = [Fraction(value) for value in latent[0].tolist()]
    exact = -(rows[1][0] * b[0] + rows[2][0] * b[1]) / rows[0][0]
    precision = [[sum(x * y for x, y in zip(p, q, strict=True)) for q in rows] for p in rows]
    cofactors = inverse_times_determinant(precision)
    s_bb = cofactors[1][1] * cofactors[2][2] - cofactors[1][2] ** 2
    x = (cofactors[2][2] * b[0] - cofactors[1][2] * b[1]) / s_bb
    y = (cofactors[1][1] * b[1] - cofactors[1][2] * b[0]) / s_bb
    assert cofactors[0][1] * x + cofactors[0][2] * y == exact
    for found in (by_precision(L, latent, torch.float64), by_covariance(L, latent, torch.float64)):
        assert float(found) == pytest.approx(float(exact), rel=1e-9)


def inverse_times_determinant(m: list[list[Fraction]]) -> list[list[Fraction]]:
    """The adjugate of a symmetric 3 x 3 matrix."""

    def minor(i: int, j: int) -> Fraction:
        (a, b), (c, d) = [[m[r][k] for k in range(3) if k != j] for r in range(3) if r != i]
        return (-1) ** (i + j) * (a * d - b * c)

    return [[minor(j, i) for j in range(3)] for i in range(3)]


def test_a_median_that_is_no_number_counts_as_a_failure() -> None:
    rows = [Row(FORMS[1], 2, 1.0, 1e-8, 1e-7), Row(FORMS[1], 2, 1e5, float("nan"), float("nan"))]
    assert fails_at(rows, FORMS[1], 2) == 1e5


def test_quick_run_prints_a_table_and_writes_figures_and_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", "stability", "--quick", "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "stability.json").read_text())
    assert {row["form"] for row in written["rows"]} == set(FORMS)
    assert (tmp_path / "stability.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out.splitlines()
    assert len([line for line in printed if line.split()[:1] in (["trick"], ["direct"])]) == len(FORMS) * 4
    page = (tmp_path / "stability.md").read_text().splitlines()
    table = page[page.index("```") + 1 : -1]
    assert page[0] == "# `avatar bench stability`" and table == printed[: len(table)] and len(table) > len(FORMS) * 4
