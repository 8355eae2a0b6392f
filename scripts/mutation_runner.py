"""Plant one mistake after another in the program, and see that the tests catch each of them.

Every mistake gets a process of its own, in which its module is loaded from a changed copy in a temporary folder; the
checkout is not touched. A mistake counts as caught where an assertion of a test fails, not where the program merely stops
with an error. `mutate.py` and `mutate_kernels.py` say what to plant.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
# Without what takes longer than most of these tests do: other plugins, rewritten assertions, a collection of all garbage.
QUIET = ["-x", "-q", "--no-header", "--assert=plain", "-p", "pytest_timeout", "-p", "no:cacheprovider"]
QUIET += ["-p", "no:unraisableexception", "-p", "no:threadexception"]
os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"


class Mutation(NamedTuple):
    file: str  # Python file, below the checkout
    what: str  # it does wrong
    old: str  # occurs once in the file
    new: str
    tests: tuple[str, ...]  # pytest's names, the soonest first

    @property
    def module(self) -> str:
        return self.file.removesuffix(".py").replace("/", ".")

    def source(self) -> str:
        """The changed file's text."""
        text = (ROOT / self.file).read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise SystemExit(f"{self.file} has {text.count(self.old)} times {self.old!r}, not once")
        return text.replace(self.old, self.new)


class Outcome(NamedTuple):
    caught_by: str | None  # the test whose assertion failed
    passed: int
    otherwise: str  # what went wrong that is no assertion
    seconds: float


class Task(NamedTuple):
    name: str
    tests: tuple[str, ...]
    mutation: Mutation | None  # None: the program as it is


class Changed(MetaPathFinder):
    """Finds one module in another file."""

    def __init__(self, name: str, path: Path) -> None:
        self._name, self._path = name, path

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        return spec_from_file_location(name, self._path) if name == self._name else None


def check_arrays_first() -> None:
    """Install the tests' import hook now: it would find the changed module's own file if it came later."""
    sys.path.insert(0, str(ROOT / "tests" / "helpers"))
    import array_shapes

    array_shapes.install_array_checks()
    array_shapes.install_array_checks = lambda: None  # of conftest.py


class Listener:
    """What pytest's tests come to."""

    def __init__(self) -> None:
        self.caught_by: str | None = None
        self.otherwise = ""
        self.passed = 0

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]) -> Any:
        report = (yield).get_result()
        self.passed += report.passed and report.when == "call"
        if call.excinfo is None:
            return
        if call.when == "call" and is_assertion(call.excinfo):
            self.caught_by = item.nodeid
        elif report.skipped:
            self.otherwise = f"{item.nodeid} was skipped"
        else:
            self.otherwise = f"{item.nodeid}: {call.excinfo.exconly()}"


def is_assertion(info: pytest.ExceptionInfo[BaseException]) -> bool:
    """Whether a test's own assertion failed, `pytest.raises` among them."""
    return info.errisinstance(AssertionError) or (
        info.errisinstance(pytest.fail.Exception) and str(info.value).startswith("DID NOT RAISE")
    )


def attempt(task: Task) -> Outcome:
    """In a process that has not loaded the module yet, and will not be used again."""
    assert task.mutation is None or task.mutation.module not in sys.modules
    torch.set_num_threads(1)
    begin, listener = time.monotonic(), Listener()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()) as said:
        if task.mutation is not None:
            path = Path(folder) / Path(task.mutation.file).name
            path.write_text(task.mutation.source(), encoding="utf-8")
            check_arrays_first()
            sys.meta_path.insert(0, Changed(task.mutation.module, path))
        with contextlib.redirect_stderr(said):
            status = pytest.main([*QUIET, *task.tests], plugins=[listener])
    if listener.caught_by is None and not listener.otherwise and status != pytest.ExitCode.OK:
        listener.otherwise = (said.getvalue().strip().splitlines() or [f"pytest ended with {status}"])[-1]
    return Outcome(listener.caught_by, listener.passed, listener.otherwise, time.monotonic() - begin)


def options(description: str | None) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--changed-only", action="store_true", help="the tests are known to pass without a mistake")
    parser.add_argument("--only", default="", metavar="WORD", help="mistakes in a file or a description with it")
    return parser


def run(tasks: Sequence[Task], jobs: int, load: Callable[[], object]) -> int:
    """Print what becomes of each; 1 when a mistake goes unseen, or a test fails without one.

    `load` imports what every process needs, and no module that is changed.
    """
    if not tasks:
        raise SystemExit("no mistake is chosen: --only takes a part of a file's name or of a description")
    for task in tasks:
        if task.mutation is not None:
            task.mutation.source()
    os.chdir(ROOT)
    load()
    wrong = 0
    # Forked, so that nobody waits for torch to be imported again.
    with multiprocessing.get_context("fork").Pool(jobs, maxtasksperchild=1) as pool:
        for task, found in zip(tasks, pool.imap(attempt, tasks, chunksize=1), strict=True):
            if task.mutation is None:
                is_wrong = found.caught_by is not None or bool(found.otherwise) or not found.passed
                verdict = found.caught_by or found.otherwise or f"{found.passed} tests pass"
            else:
                is_wrong = found.caught_by is None
                verdict = found.caught_by or f"MISSED {found.otherwise or f'by {found.passed} tests'}"
            wrong += is_wrong
            print(f"{task.name}: {verdict} ({found.seconds:.0f} s)", flush=True)
    planted = sum(task.mutation is not None for task in tasks)
    print(f"{planted} mistakes, {wrong} of {len(tasks)} runs not as they must be")
    return 1 if wrong else 0
