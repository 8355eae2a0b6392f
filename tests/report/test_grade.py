"""Words for the main figures of a report."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from avatar.report.grade import BOUNDS, word_of
from avatar.report.page import _main_figures

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("figure", "value", "word"), [
    ("psnr", 27.0, "good"), ("psnr", 26.99, "fair"), ("psnr", 23.0, "fair"), ("psnr", 22.99, "poor"),
    ("ssim", 0.91, "good"), ("ssim", 0.85, "fair"), ("ssim", 0.7, "poor"),
    ("lpips squeeze", 0.03, "good"), ("lpips squeeze", 0.031, "fair"), ("lpips squeeze", 0.051, "poor"),
    ("lpips vgg", 0.051, None), ("lpips alex", 0.01, None), ("lpips None", 0.01, None),
])  # fmt: skip
def test_a_word_of_a_figure_follows_its_bounds(figure: str, value: float, word: str | None) -> None:
    assert word_of(figure, value) == word


def test_the_docs_hold_the_bounds() -> None:
    text = (ROOT / "docs" / "evaluation.md").read_text(encoding="utf-8")
    (numbers,) = re.findall(
        r"good from PSNR (\S+), SSIM (\S+), LPIPS (\S+) \(squeeze\); fair from (\S+), (\S+), (\S+)\.\s",
        text,
    )
    assert tuple(map(float, numbers)) == (*(b.good for b in BOUNDS.values()), *(b.fair for b in BOUNDS.values()))


def test_main_figures_have_words_where_the_head_alone_is_measured() -> None:
    means = {"psnr": 31.0, "psnr_head": 28.1, "ssim_head": 0.85, "lpips_head": 0.2, "lpips": None}
    entry = {"driven_by": "tracked", "means": means, "lpips": {"network": "squeeze"}}
    shown = "".join(_main_figures({"protocols": {"mine": entry}}))
    badges = re.findall(r'<dd>([\d.]+) <span class="badge (\w+)">(\w+)</span></dd>', shown)
    assert badges == [("28.10", "fine", "good"), ("0.8500", "warning", "fair"), ("0.2000", "error", "poor")]
    assert "SSIM at least 0.90 good, 0.79 fair; LPIPS (squeeze) at most 0.03 good, 0.05 fair." in shown
    whole = {**entry, "means": {"psnr": 31.0, "lpips": 0.01}, "lpips": {"network": "alex"}}
    assert "badge" not in "".join(_main_figures({"protocols": {"mine": whole}}))
    scaled = {**entry, "means": {**means, "lpips_head": 0.01}, "choices": {"lpips_scale": 0.05}}
    shown = "".join(_main_figures({"protocols": {"mine": scaled}}))
    assert "<dd>0.0100</dd>" in shown and "LPIPS (squeeze)" not in shown, "a scaled LPIPS is below every bound"
