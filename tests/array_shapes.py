"""The type checker of jaxtyping's import hook: shapes and dtypes of arrays are checked at every call, and nothing else."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any

import jaxtyping
import pytest
from beartype import beartype

ARRAY = re.compile(r"\b(Float|Float32|Int|Bool|UInt8|Shaped)\[")
TAKEN_ONCE = re.compile(r"Iterable|Iterator|Generator")  # a look at the first of them would take it


def checked_modules() -> list[str]:
    """All of the program but the kernels, whose source Triton reads."""
    spec = find_spec("avatar")
    assert spec is not None
    return [f"avatar.{m.name}" for m in iter_modules(spec.submodule_search_locations) if m.name != "kernels"] + [
        "data_prep"
    ]


def check_arrays(function: Callable[..., Any]) -> Callable[..., Any]:
    hints = {name: str(hint) for name, hint in function.__annotations__.items()}
    arrays = {name for name, hint in hints.items() if ARRAY.search(hint) and not TAKEN_ONCE.search(hint)}
    if not arrays:
        return function
    function.__annotations__ = {name: function.__annotations__[name] for name in arrays}
    return beartype(function)


@pytest.fixture
def any_shapes() -> Iterator[None]:
    """For tests of the program's own refusals: arrays of wrong shapes reach it."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
