"""The tests' own check of arrays is at work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from array_shapes import ARRAY
from jaxtyping import TypeCheckError

from avatar.files.pickles import load_pickle
from avatar.head.assets import HeadAssets
from avatar.losses.metrics import psnr
from avatar.types import HeadParams


def test_functions_and_dataclasses_are_checked_where_they_have_arrays() -> None:
    with pytest.raises(TypeCheckError, match="target"):
        psnr(torch.zeros(4, 4, 3), torch.zeros(5, 4, 3))
    with pytest.raises(TypeCheckError, match="expression"):
        HeadParams(torch.zeros(1, 10), torch.zeros(6), torch.zeros(12), torch.zeros(2), torch.zeros(6))
    assert hasattr(HeadAssets.__init__, "__wrapped__") and not hasattr(load_pickle, "__wrapped__")


@pytest.mark.usefixtures("any_shapes")
def test_wrong_shapes_reach_the_programs_own_refusal() -> None:
    with pytest.raises(ValueError, match="target"):
        psnr(torch.zeros(4, 4, 3), torch.zeros(5, 4, 3))


def test_shapes_are_texts() -> None:
    """jaxtyping checks nothing where it cannot evaluate an annotation, such as Float[Tensor, 3]."""
    root = Path(__file__).parents[1]
    sources = [path for folder in ("avatar", "data_prep") for path in (root / folder).rglob("*.py")]
    shaped = re.compile(ARRAY.pattern + r"[\w.]+,\s*(.)")
    found = {match[0] for path in sources for match in shaped.finditer(path.read_text(encoding="utf-8"))}
    assert len(found) > 10 and all(text.endswith('"') for text in found), found
