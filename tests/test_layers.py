"""Imports go one way: data_prep to avatar's types, head model and files; back only from the command line."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
COMMAND_LINE = {"avatar/commands", "avatar/bench"}
BELOW = {"types", "errors", "tensors", "compute", "head", "data", "files", "html"}  # what importers may build on
END_OF_THE_PATH = "avatar/motion/reenact.py"  # motion in, video out: it uses all before it, and nothing uses it
# No package imports one that is to its right in this order, which is that of the data.
ORDER = [
    "files",
    "tensors",
    "head",
    "data",
    "gaussians",
    "splat",
    "losses",
    "tracking",
    "motion",
    "runs",
    "train",
    "refine",
    "evaluation",
]


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module


def modules(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("path", modules("avatar"), ids=lambda p: str(p.relative_to(ROOT)))
def test_only_the_command_line_uses_the_importers(path: Path) -> None:
    if not any(path.is_relative_to(ROOT / place) for place in COMMAND_LINE):
        assert not [name for name in imports(path) if name.split(".")[0] == "data_prep"]


@pytest.mark.parametrize("path", modules("data_prep"), ids=lambda p: str(p.relative_to(ROOT)))
def test_importers_build_on_what_is_below_them(path: Path) -> None:
    used = {name.split(".")[1] for name in imports(path) if name.startswith("avatar.")}
    assert used <= BELOW


@pytest.mark.parametrize("package", ORDER)
def test_packages_follow_the_data(package: str) -> None:
    above = set(ORDER[ORDER.index(package) + 1 :]) | {"commands", "cli", "bench"}
    place = ROOT / "avatar" / package
    for path in sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
        used = {name.split(".")[1] for name in imports(path) if name.startswith("avatar.")}
        assert path.match(END_OF_THE_PATH) or not used & above, path


def test_the_root_of_the_package_stays_small() -> None:
    assert len(list((ROOT / "avatar").glob("*.py"))) <= 10


def test_files_stay_small() -> None:
    paths = [*modules("avatar"), *modules("data_prep"), *modules("tests")]
    long = [str(path) for path in paths if len(path.read_text(encoding="utf-8").splitlines()) > 300]
    assert not long


@pytest.mark.parametrize("path", sorted((ROOT / "scripts").rglob("*.sh")), ids=lambda p: p.name)
def test_scripts_name_tests_that_are_there(path: Path) -> None:
    for name in re.findall(r"\btests/[\w/.]*\w", path.read_text(encoding="utf-8")):
        assert (ROOT / name).exists(), f"{path.name} names {name}"
