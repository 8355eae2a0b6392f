"""Imports go one way, and every package and module of avatar/ and data_prep/ has its place in that way."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from avatar.compute.gpu_functions import GPU_FUNCTIONS

ROOT = Path(__file__).resolve().parents[1]
# None of these imports one that comes after it, inside of functions neither.
ORDER = [
    *("avatar.errors", "avatar.version", "avatar.tensors", "avatar.files", "avatar.html"),
    *("avatar.compute", "avatar.types", "avatar.kernels"),
    *("avatar.head", "avatar.data", "avatar.config_values", "avatar.config"),
    *("data_prep", "data_prep.formats", "data_prep.prepare", "data_prep.check", "data_prep.track", "data_prep.live"),
    *("avatar.losses", "avatar.splat", "avatar.gaussians", "avatar.model", "avatar.baselines"),
    *("avatar.gaussianheadavatar", "avatar.render"),
    *("avatar.pose_refinement", "avatar.motion", "avatar.runs", "avatar.train", "avatar.evaluation"),
    *("avatar.pipeline", "avatar.report", "avatar.view", "avatar.export", "avatar.sweep"),
    *("avatar.demo", "avatar.bench", "avatar.commands", "avatar.cli", "avatar"),
]
# What may use the importers of data_prep.
ON_TOP = {"avatar.pipeline", "avatar.view", "avatar.bench", "avatar.commands"}
BELOW = {"types", "errors", "version", "tensors", "compute", "head", "data", "files", "html"}  # what importers may use


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module in ("avatar", "data_prep"):
            yield from (
                f"{node.module}.{alias.name}" for alias in node.names if alias.name != "_core"
            )  # the compiled one
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module


def modules(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def room(name: str) -> str:
    """Of a module or of what is imported from one: the entry of ORDER that it belongs to."""
    place = ".".join(name.split(".")[:2])
    return place if place in ORDER else name.split(".")[0]


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_of(path): path for folder in ("avatar", "data_prep") for path in modules(folder)}


def test_every_package_and_module_has_a_place() -> None:
    names = {".".join(name.split(".")[:2]) for name in MODULES}
    folders = {name for name in names if (ROOT / name.replace(".", "/")).is_dir()}
    assert {name for name in names if name.startswith("avatar")} | folders == {*ORDER}


@cache
def all_imports() -> dict[str, set[str]]:
    """Of each module; parsed in the worker that asks, not wherever tests are collected."""
    return {
        name: {other for other in imports(path) if other.split(".")[0] in ("avatar", "data_prep")}
        for name, path in MODULES.items()
    }


def test_imports_go_one_way() -> None:
    up = [
        (name, other)
        for name, used in all_imports().items()
        for other in used
        if ORDER.index(room(other)) > ORDER.index(room(name))
    ]
    assert not up


def test_only_what_is_on_top_uses_the_importers() -> None:
    users = {room(name) for name, used in all_imports().items() if any(other.startswith("data_prep") for other in used)}
    assert {user for user in users if user.startswith("avatar")} <= ON_TOP


def test_only_the_table_leads_to_the_gpu() -> None:
    """What imports Triton is imported by its like and through the table of GPU functions, and by nothing else."""
    of_gpu = {
        name for name, used in all_imports().items() if any(other.startswith("avatar.kernels.") for other in used)
    }
    of_gpu |= {place.rpartition(".")[0] for place in GPU_FUNCTIONS.values()}
    leaks = {(name, other) for name, used in all_imports().items() for other in used & of_gpu if name not in of_gpu}
    assert not leaks


def test_the_functions_in_the_table_are_there() -> None:
    for place in GPU_FUNCTIONS.values():
        module, _, name = place.rpartition(".")
        text = MODULES[module].read_text(encoding="utf-8")
        assert f"\ndef {name}(" in text or f"\nclass {name}(" in text, place


def test_importers_build_on_what_is_below_them() -> None:
    used = {(name, other) for name, used in all_imports().items() if name.startswith("data_prep") for other in used}
    assert not [pair for pair in used if pair[1].startswith("avatar.") and pair[1].split(".")[1] not in BELOW]


def test_the_root_of_the_package_stays_small() -> None:
    assert len(list((ROOT / "avatar").glob("*.py"))) <= 10


def test_files_stay_small() -> None:
    paths = [*modules("avatar"), *modules("data_prep"), *modules("tests")]
    long = [str(path) for path in paths if len(path.read_text(encoding="utf-8").splitlines()) > 300]
    assert not long


@pytest.mark.parametrize("path", sorted((ROOT / "scripts").rglob("*.py")) + modules("tests/gpu"), ids=lambda p: p.name)
def test_names_imported_by_scripts_and_gpu_tests_are_there(path: Path) -> None:
    """What needs Triton or a browser is not imported on every machine that runs the tests."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("avatar", "data_prep"):
            text = MODULES[str(node.module)].read_text(encoding="utf-8")
            for name in (alias.name for alias in node.names if alias.name != "_core"):
                assert f"{node.module}.{name}" in MODULES or re.search(rf"\b{name}\b", text), f"{path}: {name}"


@pytest.mark.parametrize("path", sorted((ROOT / "scripts").rglob("*.sh")), ids=lambda p: p.name)
def test_scripts_name_tests_that_are_there(path: Path) -> None:
    for name in re.findall(r"\btests/[\w/.]*\w", path.read_text(encoding="utf-8")):
        assert (ROOT / name).exists(), f"{path.name} names {name}"
