"""Training and refinement in turns, and then the run itself.

RUN/rounds/plan.json      what the rounds began with
RUN/rounds/1/run          a first, shorter training
RUN/rounds/1/NAME         the subject, refined through its avatar: what the next round, or the run itself, trains on
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from avatar.config import load_config
from avatar.data.source import Source
from avatar.files.lock import locked
from avatar.files.names import ROUNDS_FOLDER, RUN_FOLDER, safe_name
from avatar.pipeline import OK
from avatar.pipeline.open_inputs import open_run
from avatar.pipeline.refine_plan import Plan, steps_in_time
from avatar.pipeline.refine_run import refine_run
from avatar.pipeline.train import resume_run, train_new
from avatar.runs.checkpoint import list_checkpoints
from avatar.runs.model_registry import refuse_features
from avatar.runs.run import RUN_FILE


def begin_rounds(
    run: Path, rounds: int, minutes: float | None, source: Source, overrides: list[str], begin: float
) -> int:
    """The minutes are counted from `begin` on, of `time.monotonic`: they include the tracking of a video."""
    refuse_features(load_config(overrides).model, "--refine")
    iterations, in_rounds = steps_in_time(source, overrides, rounds, minutes, begin)
    plan = Plan(rounds, source, tuple(overrides), minutes, iterations, in_rounds, time.monotonic() - begin)
    with locked(run / ROUNDS_FOLDER):
        plan.save(run)
        return train_refined(run, plan, source, begin)


def train_refined(run: Path, plan: Plan, source: Source, begin: float) -> int:
    """Train, refine, and so on, and at last train the run itself; what is done already is not done again."""
    name = refined_name(plan)
    for number in range(1, plan.rounds + 1):
        stage = run / ROUNDS_FOLDER / str(number)
        if not (stage / name).is_dir():
            print(f"Round {number} of {plan.rounds}: a first avatar, and the tracking refined through it")
            status, plan = train_round(plan, source, stage, begin, plan.rounds - number)
            plan.save(run)
            if status != OK:
                return status
        # The folder knows its tracking, numbers, rate and cameras; what was let pass in the first is let pass in it.
        known = dict.fromkeys(("tracking", "frame_offset", "data_format", "fps", "cameras"))
        source = replace(source, folder=stage / name, **known)
    status = continue_or_begin(source, plan.final_overrides(), run)
    plan = replace(plan, spent=time.monotonic() - begin)
    plan.save(run)
    if status == OK and plan.minutes is not None:
        print(f"Time         {plan.spent / 60:.1f} of {plan.minutes:g} minutes")
    return status


def train_round(plan: Plan, source: Source, stage: Path, begin: float, to_come: int) -> tuple[int, Plan]:
    """The round in the folder `stage`, with `to_come` after it; and the plan, with the time that is gone. A round that was
    made in one sitting shows what steps take, and so how many there is time for."""
    at_once, started = not is_begun(stage / RUN_FOLDER), time.monotonic()
    status = continue_or_begin(source, plan.round_overrides(), stage / RUN_FOLDER)
    trained = time.monotonic()
    if status != OK:
        return status, replace(plan, spent=trained - begin)
    run = open_run(stage / RUN_FOLDER, source.head, source.folder)
    status = refine_run(run, stage / refined_name(plan), load_config(plan.overrides).device)
    refined = time.monotonic()
    plan = replace(plan, spent=refined - begin)
    if status == OK and at_once and plan.minutes is not None:
        step = (trained - started) / plan.round_iterations
        plan = plan.replanned(step, refined - trained, to_come, len(run.subject.split.train))
    return status, plan


def refined_name(plan: Plan) -> str:
    """The tracked folder's own, where that is not the round's run's."""
    name = safe_name(plan.source.folder.resolve().name)
    return f"{name}-refined" if name.lower() == RUN_FOLDER else name


def continue_or_begin(source: Source, overrides: list[str], run: Path) -> int:
    if is_begun(run):
        return resume_run(run, source.head, source.folder, load_config(overrides).device)
    return train_new(source, overrides, run)


def is_begun(run: Path) -> bool:
    return (run / RUN_FILE).is_file() and bool(list_checkpoints(run / "checkpoints"))
