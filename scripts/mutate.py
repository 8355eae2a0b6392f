"""Plant one mistake after another in avatar/ and data_prep/, and see that tests of the same package catch each of them.

    python scripts/mutate.py [--jobs 2] [--only WORD] [--changed-only]

The mistakes are those of `mutations.toml`: held-out frames that reach training, a wrong sign, side, threshold, weight or
index, a stale cache key. The same tests pass without a mistake, which is the first thing tried unless --changed-only
says that it has been. Ends with status 1 when a mistake goes unseen. The GPU's kernels have `mutate_kernels.py`.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

from mutation_runner import Mutation, Task, options, run

LIST = Path(__file__).with_name("mutations.toml")


def read_mutations() -> list[Mutation]:
    found = tomllib.loads(LIST.read_text(encoding="utf-8"))["mutation"]
    return [Mutation(**{**values, "tests": tuple(values["tests"])}) for values in found]


def load() -> None:
    """What the tests import besides the program."""
    import cv2  # noqa: F401
    import hydra  # noqa: F401
    import imageio  # noqa: F401
    import kornia  # noqa: F401
    import matplotlib.pyplot  # noqa: F401
    import safetensors.torch  # noqa: F401
    import scipy.linalg
    import scipy.spatial
    import scipy.stats  # noqa: F401
    import trimesh  # noqa: F401


def main() -> int:
    arguments = options(__doc__).parse_args()
    chosen = [m for m in read_mutations() if arguments.only in f"{m.file}: {m.what}"]
    tests = tuple(sorted({test for mutation in chosen for test in mutation.tests}))
    unchanged = [] if arguments.changed_only or not tests else [Task("the program as it is", tests, None)]
    tasks = [*unchanged, *(Task(f"{m.file}: {m.what}", m.tests, m) for m in chosen)]
    return run(tasks, arguments.jobs, load)


if __name__ == "__main__":
    sys.exit(main())
