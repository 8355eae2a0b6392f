"""The planted mistakes of `make mutate` and `make gpu-check` fit the program: what they change is there, once."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest
from kernel_mutations import SPLATTER_MUTATIONS
from kernel_mutations_avatar import AVATAR_MUTATIONS
from kernel_mutations_features import FEATURE_MUTATIONS

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ROOT / "scripts"
OWN = tomllib.loads((SCRIPTS / "mutations.toml").read_text(encoding="utf-8"))["mutation"]
KERNELS = [
    {"file": f"avatar/kernels/{mutation.module}.py", "what": mutation.what, "old": mutation.old, "new": mutation.new}
    for mutation in SPLATTER_MUTATIONS + FEATURE_MUTATIONS + AVATAR_MUTATIONS
]


@pytest.mark.parametrize("planted", [OWN, KERNELS], ids=["mutations.toml", "kernel_mutations.py"])
def test_what_a_planted_mistake_changes_is_there_once(planted: list[dict[str, str]]) -> None:
    problems = []
    for mistake in planted:
        source = (ROOT / mistake["file"]).read_text(encoding="utf-8")
        if source.count(mistake["old"]) != 1:
            problems.append(f"{mistake['file']} has {source.count(mistake['old'])} times {mistake['old']!r}")
        elif mistake["old"].split() == mistake["new"].split():
            problems.append(f"{mistake['file']}: {mistake['what']}: nothing but the layout changes")
        else:
            ast.parse(source.replace(mistake["old"], mistake["new"]), mistake["file"])
    assert not problems


@pytest.mark.parametrize("planted", [OWN, KERNELS], ids=["mutations.toml", "kernel_mutations.py"])
def test_no_mistake_is_planted_twice(planted: list[dict[str, str]]) -> None:
    for keys in (("file", "what"), ("file", "old", "new")):
        found = [tuple(mistake[key] for key in keys) for mistake in planted]
        assert len({*found}) == len(found)


def test_the_tests_that_catch_mistakes_are_there() -> None:
    for test in {test for mistake in OWN for test in mistake["tests"]}:
        file, _, name = test.partition("::")
        assert (ROOT / file).is_file(), test
        assert not name or f"def {name}(" in (ROOT / file).read_text(encoding="utf-8"), test
