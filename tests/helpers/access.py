"""What axe-core finds wrong with a page: WCAG 2.2, levels A and AA."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

SIZES = {"desktop": {"width": 1280, "height": 800}, "phone": {"width": 390, "height": 844}}
RUN = """async ([kinds, exclude]) => {
  const levels = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"];
  const found = await axe.run({ exclude }, { runOnly: levels, resultTypes: kinds });
  const told = ({ id, nodes }) => nodes.map((one) => `${id}: ${one.html.slice(0, 200)} ${one.failureSummary}`);
  return kinds.flatMap((kind) => found[kind].flatMap(told));
}"""
OPEN = "document.querySelectorAll('details').forEach(box => (box.open = true))"


def violations(page: Any, *kinds: str, without: Sequence[str] = ()) -> list[str]:
    """A line for each element but those `without`; `kinds` are of axe-core's results ("incomplete": not decided)."""
    if page.evaluate("typeof axe") == "undefined":
        page.evaluate(_axe())
    return page.evaluate(RUN, [["violations", *kinds], list(without)])


def audited(page: Any) -> list[str]:
    """Violations of a page in both themes at both sizes, its parts that open closed and open."""
    found = []
    for is_open in (False, True):
        page.evaluate(f"document.querySelectorAll('details').forEach(box => (box.open = {str(is_open).lower()}))")
        for theme, size in itertools.product(("light", "dark"), SIZES.values()):
            page.emulate_media(color_scheme=theme)
            page.set_viewport_size(size)
            found += violations(page)
    return found


@functools.cache
def _axe() -> str:
    package = pytest.importorskip("axe_playwright_python")
    return (Path(package.__file__).parent / "axe.min.js").read_text(encoding="utf-8")
