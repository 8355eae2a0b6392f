"""Put one mistake after another into the GPU's kernels, and see that the tests catch each of them.

    TRITON_INTERPRET=1 python scripts/mutate_kernels.py [--jobs 2] [--only WORD] [--changed-only]

Every mistake of `kernel_mutations.py` and `kernel_mutations_avatar.py` gets a process, in which its module is loaded from
a changed copy; the checkout is not touched. It counts as caught where an assertion of a test fails, not where the program
merely falls over. The same tests pass without a mistake, which is the first thing tried unless --changed-only says that it
has been. Ends with status 1 when a mistake goes unseen.
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
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from kernel_mutations import SPLATTER_MUTATIONS, Mutation
from kernel_mutations_avatar import AVATAR_MUTATIONS

# Without what takes longer than most of these tests do: other plugins, rewritten assertions, a collection of all garbage.
QUIET = ["-x", "-q", "--no-header", "--assert=plain", "-p", "pytest_timeout", "-p", "no:cacheprovider"]
QUIET += ["-p", "no:unraisableexception", "-p", "no:threadexception"]
os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
KERNELS = Path(__file__).resolve().parents[1] / "avatar" / "kernels"
BACKENDS, CAPACITY, HOSTILE, PLACE = (
    f"tests/{name}.py::"
    for name in ("splat/test_splat_backends", "gpu/test_gpu_capacity", "gpu/test_gpu_hostile", "gpu/test_gpu_place")
)
LOOPS = BACKENDS + "test_image_and_alpha_are_those_of_the_definition_written_as_loops"
REFERENCE = BACKENDS + "test_gpu_kernels_agree_with_the_reference"
SPLATTER = [
    *(
        f"{LOOPS}[{scene}-gpu]"
        for scene in ("random", "opaque", "cut-offs", "antialiased", "beyond the Jacobian's clamp")
    ),
    *(f"{REFERENCE}[{scene}-gpu]" for scene in ("17x33", "wide field of view", "degree 3 of 3", "other cut-offs")),
    "tests/splat/test_splat_public_bugs.py::test_alpha_just_under_the_cut_off_is_skipped_and_at_it_drawn[gpu]",
    "tests/splat/test_splat_public_bugs.py::test_gradient_is_zero_where_alpha_is_clamped[gpu]",
    CAPACITY + "test_room_for_exactly_the_pairs_is_enough_and_one_less_makes_the_image_nan",
    CAPACITY + "test_a_value_that_is_not_finite_spoils_the_image_where_nobody_waits",
    CAPACITY + "test_so_does_one_of_a_pose_that_is_on_the_gpu",
    "tests/gpu/test_gpu_production.py::test_a_scene_agrees_with_the_reference[small]",
    HOSTILE + "test_the_same_bits_and_whole_bands[17x33]",
    HOSTILE + "test_the_same_bits_and_whole_bands[walls]",
    f"{REFERENCE}[thresholds-gpu]",
]
PLACING = [
    PLACE + "test_gaussians_and_gradients_are_those_of_the_steps_one_by_one[grid and heads]",
    PLACE + "test_lanes_that_stand_for_no_gaussian_get_no_gradient",
    PLACE + "test_zero_quaternions_and_saturated_offsets_have_finite_gradients",
    HOSTILE + "test_the_same_bits_and_whole_bands[placed]",
]
POSING = ["tests/gpu/test_gpu_pose.py", HOSTILE + "test_the_same_bits_and_whole_bands[posed]"]
LOSSES = ["tests/gpu/test_gpu_losses.py", HOSTILE + "test_the_same_bits_and_whole_bands[compared]"]
# Of a module; of the others SPLATTER.
TESTS = {
    **dict.fromkeys(("activations", "hyper", "place", "place_backward"), PLACING),
    **dict.fromkeys(("huber", "reduce", "ssim"), LOSSES),
    "pose": POSING,
}


class Outcome(NamedTuple):
    caught_by: str | None  # the test whose assertion failed
    passed: int
    otherwise: str  # what went wrong that is no assertion
    seconds: float


class Changed(MetaPathFinder):
    """Finds one module in another file."""

    def __init__(self, name: str, path: Path) -> None:
        self._name, self._path = name, path

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        return spec_from_file_location(name, self._path) if name == self._name else None


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
        if call.excinfo.errisinstance(AssertionError) and report.when == "call":
            self.caught_by = item.nodeid
        elif report.skipped:
            self.otherwise = f"{item.nodeid} was skipped"
        else:
            self.otherwise = f"{item.nodeid}: {call.excinfo.exconly()}"


def run_tests(tests: list[str], mutation: Mutation | None) -> Outcome:
    """In a process that has not loaded the kernels yet, and will not be used again."""
    assert not any(name.startswith("avatar.kernels.") for name in sys.modules)
    torch.set_num_threads(1)
    begin, listener = time.monotonic(), Listener()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()) as said:
        if mutation is not None:
            path = Path(folder) / f"{mutation.module}.py"
            path.write_text(mutated(mutation), encoding="utf-8")
            sys.meta_path.insert(0, Changed(f"avatar.kernels.{mutation.module}", path))
        status = pytest.main([*QUIET, *tests], plugins=[listener])
    if listener.caught_by is None and not listener.otherwise and status != pytest.ExitCode.OK:
        listener.otherwise = said.getvalue().strip().splitlines()[-1]
    return Outcome(listener.caught_by, listener.passed, listener.otherwise, time.monotonic() - begin)


def mutated(mutation: Mutation) -> str:
    source = (KERNELS / f"{mutation.module}.py").read_text(encoding="utf-8")
    if source.count(mutation.old) != 1:
        raise SystemExit(f"{mutation.module}.py has {source.count(mutation.old)} times {mutation.old!r}, not once")
    return source.replace(mutation.old, mutation.new)


def tests_of(module: str) -> list[str]:
    return TESTS.get(module, SPLATTER)


def soonest_first(mutation: Mutation) -> list[str]:
    """All tests of its module, beginning with the one that is known to see it."""
    tests = tests_of(mutation.module)
    chosen = [test for test in tests if mutation.first and mutation.first in test]
    if mutation.first and not chosen:
        raise SystemExit(f"no test of {mutation.module} is called {mutation.first!r}")
    return [*chosen, *(test for test in tests if test not in chosen)]


def attempt(task: tuple[str, Mutation | None]) -> Outcome:
    module, mutation = task
    return run_tests(tests_of(module) if mutation is None else soonest_first(mutation), mutation)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--changed-only", action="store_true", help="the tests are known to pass without a mistake")
    parser.add_argument("--only", default="", metavar="WORD", help="mistakes in a module or a description with it")
    arguments = parser.parse_args()
    if os.environ.get("TRITON_INTERPRET") != "1":
        raise SystemExit("the kernels are interpreted: set TRITON_INTERPRET=1")
    chosen = [m for m in SPLATTER_MUTATIONS + AVATAR_MUTATIONS if arguments.only in f"{m.module}: {m.what}"]
    for mutation in chosen:
        mutated(mutation), soonest_first(mutation)
    areas = {id(tests_of(m.module)): m.module for m in reversed(chosen)}.values()  # the first module of each
    tasks: list[tuple[str, Mutation | None]] = [] if arguments.changed_only else [(module, None) for module in areas]
    tasks += [(mutation.module, mutation) for mutation in chosen]
    import_all()
    wrong = 0
    # Forked, so that nobody waits for torch and Triton to be imported again.
    with multiprocessing.get_context("fork").Pool(arguments.jobs, maxtasksperchild=1) as pool:
        for (module, mutation), found in zip(tasks, pool.imap(attempt, tasks, chunksize=1), strict=True):
            if mutation is None:
                wrong += found.caught_by is not None or bool(found.otherwise) or not found.passed
                verdict = found.caught_by or found.otherwise or f"{found.passed} tests pass"
                print(f"{module}, as it is: {verdict} ({found.seconds:.0f} s)", flush=True)
                continue
            wrong += found.caught_by is None
            verdict = found.caught_by or f"UNSEEN {found.otherwise or f'by {found.passed} tests'}"
            print(f"{module}: {mutation.what}: {verdict} ({found.seconds:.0f} s)", flush=True)
    print(f"{len(chosen)} mistakes, {wrong} of {len(tasks)} runs not as they must be")
    return 1 if wrong else 0


def import_all() -> None:
    """What every process needs; none of it loads a kernel."""
    import triton.runtime.interpreter  # noqa: F401

    import avatar.bench.scenes
    import avatar.model
    import avatar.train.trainer  # noqa: F401


if __name__ == "__main__":
    sys.exit(main())
