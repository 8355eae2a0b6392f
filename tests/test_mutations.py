"""The planted mistakes of `make mutate` and `make gpu-check` fit the program: what they change is there, once."""

from __future__ import annotations

import ast
import runpy
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ROOT / "scripts"


class Planted(NamedTuple):
    file: str
    what: str
    old: str
    new: str
    tests: tuple[str, ...] = ()


def planted() -> list[Planted]:
    own = tomllib.loads((SCRIPTS / "mutations.toml").read_text(encoding="utf-8"))["mutation"]
    kernels = runpy.run_path(str(SCRIPTS / "kernel_mutations.py"))["MUTATIONS"]
    return [
        *(Planted(**{**values, "tests": tuple(values["tests"])}) for values in own),
        *(Planted(f"avatar/kernels/{m.module}.py", m.what, m.old, m.new) for m in kernels),
    ]


@pytest.mark.parametrize("mistake", planted(), ids=lambda m: f"{m.file}: {m.what}")
def test_a_planted_mistake_fits_the_program(mistake: Planted) -> None:
    source = (ROOT / mistake.file).read_text(encoding="utf-8")
    assert source.count(mistake.old) == 1, f"{mistake.file} has {source.count(mistake.old)} times {mistake.old!r}"
    changed = ast.parse(source.replace(mistake.old, mistake.new))
    assert ast.dump(changed) != ast.dump(ast.parse(source)), "nothing but the layout changes"


def test_the_tests_that_catch_mistakes_are_there() -> None:
    """In the package's own folder of tests, or at the root for modules there."""
    for mistake in planted():
        for test in mistake.tests:
            file, _, name = test.partition("::")
            path = ROOT / file
            assert path.is_file() and (not name or f"def {name}(" in path.read_text(encoding="utf-8")), test


def test_no_mistake_is_planted_twice() -> None:
    found = [(mistake.file, mistake.old, mistake.new) for mistake in planted()]
    assert len({*found}) == len(found) and len({(m.file, m.what) for m in planted()}) == len(found)
