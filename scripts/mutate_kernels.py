"""Put one mistake after another into the GPU's kernels, and see that the tests catch each of them.

    TRITON_INTERPRET=1 python scripts/mutate_kernels.py [--jobs 2] [--only WORD] [--changed-only]

The mistakes are those of `kernel_mutations*.py`. The same tests pass without a mistake,
which is the first thing tried unless --changed-only says that it has been. Ends with status 1 when a mistake goes unseen.
"""

from __future__ import annotations

import os
import sys

import kernel_mutations
from kernel_mutations_avatar import AVATAR_MUTATIONS
from kernel_mutations_features import FEATURE_MUTATIONS
from mutation_runner import Mutation, Task, options, run

BACKENDS, SPLAT_FEATURES, BUFFERS, HOSTILE, PLACE = (
    f"tests/{folder}/test_{name}.py::"
    for folder, name in (
        ("splat", "splat_backends"),
        ("splat", "splat_features"),
        ("gpu", "gpu_buffers"),
        ("gpu", "gpu_hostile"),
        ("gpu", "gpu_fused_gaussians"),
    )
)
LOOPS = BACKENDS + "test_image_and_alpha_are_those_of_the_definition_written_as_loops"
REFERENCE = BACKENDS + "test_gpu_kernels_agree_with_the_reference"
FEATURE_THAT_SPOILS = BUFFERS + "test_a_feature_that_is_not_finite_spoils_the_image_where_nobody_waits"
SPLATTER = [
    *(
        f"{LOOPS}[{scene}-gpu]"
        for scene in ("random", "opaque", "cut-offs", "antialiased", "beyond the Jacobian's clamp")
    ),
    *(f"{REFERENCE}[{scene}-gpu]" for scene in ("17x33", "wide field of view", "degree 3 of 3", "other cut-offs")),
    "tests/splat/test_splat_public_bugs.py::test_alpha_just_under_the_cut_off_is_skipped_and_at_it_drawn[gpu]",
    "tests/splat/test_splat_public_bugs.py::test_gradient_is_zero_where_alpha_is_clamped[gpu]",
    BUFFERS + "test_room_for_exactly_the_pairs_is_enough_and_one_less_makes_the_image_nan",
    BUFFERS + "test_a_value_that_is_not_finite_spoils_the_image_where_nobody_waits",
    FEATURE_THAT_SPOILS,
    BUFFERS + "test_so_does_one_of_a_pose_that_is_on_the_gpu",
    "tests/gpu/test_gpu_production.py::test_a_scene_agrees_with_the_reference[small]",
    HOSTILE + "test_the_same_bits_and_whole_bands[17x33]",
    HOSTILE + "test_the_same_bits_and_whole_bands[walls]",
    f"{REFERENCE}[thresholds-gpu]",
]
FEATURES = [
    *(f"{SPLAT_FEATURES}test_gpu_kernels_agree_with_the_reference[{channels}-gpu]" for channels in (5, 33)),
    *(
        f"{SPLAT_FEATURES}test_gpu_kernels_agree_with_the_reference_on_other_scenes[{scene}-gpu]"
        for scene in ("walls", "other cut-offs")
    ),
    SPLAT_FEATURES + "test_each_output_has_its_own_gradient[alpha-gpu]",
    FEATURE_THAT_SPOILS,
    HOSTILE + "test_the_same_bits_and_whole_bands[features]",
]
FUSED = [
    PLACE + "test_gaussians_and_gradients_are_those_of_the_steps_one_by_one[grid and heads]",
    PLACE + "test_lanes_that_stand_for_no_gaussian_get_no_gradient",
    PLACE + "test_zero_quaternions_and_saturated_offsets_have_finite_gradients",
    HOSTILE + "test_the_same_bits_and_whole_bands[placed]",
]
POSING = ["tests/gpu/test_gpu_pose.py", HOSTILE + "test_the_same_bits_and_whole_bands[posed]"]
LOSSES = ["tests/gpu/test_gpu_losses.py", HOSTILE + "test_the_same_bits_and_whole_bands[compared]"]
ADAM = ["tests/gpu/test_gpu_adam.py"]
# Of a module; of the others SPLATTER.
TESTS = {
    **dict.fromkeys(("activations", "hyper", "fused_gaussians", "fused_gaussians_backward"), FUSED),
    **dict.fromkeys(("huber", "reduce", "ssim"), LOSSES),
    "pose": POSING,
    "adam": ADAM,
    "composite_features": FEATURES,
}


def tests_of(module: str) -> list[str]:
    return TESTS.get(module, SPLATTER)


def soonest_first(mutation: kernel_mutations.Mutation) -> list[str]:
    """All tests of its module, beginning with the one that is known to see it."""
    tests = tests_of(mutation.module)
    chosen = [test for test in tests if mutation.first and mutation.first in test]
    if mutation.first and not chosen:
        raise SystemExit(f"no test of {mutation.module} is called {mutation.first!r}")
    return [*chosen, *(test for test in tests if test not in chosen)]


def task_of(mutation: kernel_mutations.Mutation) -> Task:
    file, tests = f"avatar/kernels/{mutation.module}.py", tuple(soonest_first(mutation))
    planted = Mutation(file, mutation.what, mutation.old, mutation.new, tests)
    return Task(f"{mutation.module}: {mutation.what}", tests, planted)


def main() -> int:
    arguments = options(__doc__).parse_args()
    if os.environ.get("TRITON_INTERPRET") != "1":
        raise SystemExit("the kernels are interpreted: set TRITON_INTERPRET=1")
    planted = kernel_mutations.SPLATTER_MUTATIONS + FEATURE_MUTATIONS + AVATAR_MUTATIONS
    chosen = [m for m in planted if arguments.only in f"{m.module}: {m.what}"]
    areas = {id(tests_of(m.module)): m.module for m in reversed(chosen)}.values()  # the first module of each
    unchanged = [Task(f"{module}, as it is", tuple(tests_of(module)), None) for module in areas]
    tasks = [*([] if arguments.changed_only else unchanged), *map(task_of, chosen)]
    return run(tasks, arguments.jobs, load)


def load() -> None:
    import triton.runtime.interpreter  # noqa: F401

    import avatar.model
    import avatar.splat.scenes
    import avatar.train.trainer  # noqa: F401


if __name__ == "__main__":
    sys.exit(main())
