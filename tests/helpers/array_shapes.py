"""Shapes and dtypes of annotated arrays are checked at every call, by jaxtyping's import hook."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any, TypeVar

import jaxtyping
import pytest
from beartype import beartype

Checked = TypeVar("Checked", bound=Callable[..., Any])
ARRAY = re.compile(r"\b(Float|Float32|Int|Bool|UInt8|Shaped)\[")
TAKEN_ONCE = re.compile(r"Iterable|Iterator|Generator")  # a look at the first of them would take it


def install_array_checks() -> None:
    """Before the first import of the program."""
    decorator = jaxtyping.jaxtyped

    def jaxtyped(*, typechecker: Any) -> Callable[[Checked], Checked]:
        # The hook asks for every function, and a checked call takes 40 us: hostile pickles make half a million.
        return lambda checked: decorator(checked, typechecker=typechecker) if array_hints(checked) else checked

    jaxtyping.jaxtyped = jaxtyped
    jaxtyping.install_import_hook(checked_modules(), "array_shapes.check_arrays")


def checked_modules() -> list[str]:
    """All of the program but the kernels, whose source Triton reads."""
    spec = find_spec("avatar")
    assert spec is not None
    names = [module.name for module in iter_modules(spec.submodule_search_locations)]
    return ["data_prep", *(f"avatar.{name}" for name in names if name != "kernels")]


def array_hints(annotated: Any) -> dict[str, Any]:
    """The annotations of a function or a class that are of arrays."""
    hints = getattr(annotated, "__annotations__", {})
    return {name: hint for name, hint in hints.items() if ARRAY.search(str(hint)) and not TAKEN_ONCE.search(str(hint))}


def check_arrays(function: Callable[..., Any]) -> Callable[..., Any]:
    """The type checker that the hook is given."""
    arrays = array_hints(function)
    if not arrays:
        return function
    function.__annotations__ = arrays
    return beartype(function)


@pytest.fixture
def any_shapes() -> Iterator[None]:
    """For tests of the program's own refusals: arrays of wrong shapes reach it."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
