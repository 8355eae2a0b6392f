"""avatar train --refine N: training and refinement in turns, and then the run itself.

RUN/rounds/plan.json      what the rounds began with
RUN/rounds/1/run          a first, shorter training
RUN/rounds/1/NAME         the subject, refined through its avatar: what the next round, or the run itself, trains on
"""

from __future__ import annotations

import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

from avatar.commands import OK, training
from avatar.commands.opening import at_new_place, open_run
from avatar.commands.outputs import check_run_folder
from avatar.commands.plan import ROUNDS_FOLDER, Pace, Plan, plan_file, steps_in_time
from avatar.commands.refining import refine_run
from avatar.commands.training import resume_run, train_new
from avatar.config import load_config
from avatar.data.source import Source
from avatar.errors import UserError
from avatar.files.lock import locked
from avatar.files.names import safe_name
from avatar.runs.checkpoint import list_checkpoints
from avatar.runs.run import RUN_FILE, refuse_trained

MAX_ROUNDS = 10


def run_train(arguments: Namespace) -> int:
    """With rounds where they are asked for, or were when the run began; else `training`."""
    settle_paths(arguments)
    run = arguments.out or training.default_run(arguments.folder)
    overrides = training.config_overrides(arguments)
    if arguments.device is not None and (arguments.refine is not None or plan_file(run).exists()):
        overrides.append(f"device={arguments.device}")
    if arguments.resume and plan_file(run).exists():
        training.forget_video(arguments)
        plan = Plan.load(run)
        refuse_changes(run, plan, arguments, overrides)
        source = moved_source(run, plan.source, arguments)
        with locked(run / ROUNDS_FOLDER):
            return train_refined(run, plan, source, time.monotonic() - plan.spent)
    if arguments.refine is None:
        if arguments.minutes is not None:
            raise UserError("--minutes goes with --refine; without it, say --iterations")
        return training.run_train(arguments)
    if arguments.resume:
        raise UserError(f"{run} began without --refine: leave it out to resume, or start a new run")
    begin = time.monotonic()
    check_run_folder(run, [arguments.folder, arguments.head, arguments.tracking])
    check_rounds(run, arguments.refine, arguments.minutes, overrides)
    source = training.tracked_source(arguments)
    return begin_rounds(run, arguments.refine, arguments.minutes, source, overrides, begin)


def settle_paths(arguments: Namespace) -> None:
    """Which of the paths that were typed without an option is the run, and which the tracked folder."""
    runs = [path for path in arguments.paths if (path / RUN_FILE).is_file() or plan_file(path).is_file()]
    if runs and not arguments.resume:
        raise UserError(f"{runs[0]} is a run: add --resume to go on with it, or give the tracked folder of a new one")
    named = [*([] if arguments.out is None else [arguments.out]), *runs]
    if len({path.resolve() for path in named}) > 1:
        raise UserError(f"{named[0]} and {named[1]} are two runs: one at a time is resumed")
    arguments.out = next(iter(named), None)
    folders = [path for path in arguments.paths if path not in runs]
    if len(folders) > 1:
        raise UserError(f"neither {folders[0]} nor {folders[1]} is a run: say which to resume with --out RUN")
    arguments.folder = arguments.folder or next(iter(folders), None)


def check_rounds(run: Path, rounds: int, minutes: float | None, overrides: list[str]) -> None:
    """Before a video is tracked. Raises UserError for a mistake, and where the folder holds a run, or rounds, already."""
    if not 1 <= rounds <= MAX_ROUNDS:
        raise UserError(f"--refine must be from 1 to {MAX_ROUNDS}, not {rounds}")
    if minutes is not None and not 0.0 < minutes < float("inf"):
        raise UserError(f"--minutes must be a positive number, not {minutes:g}")
    load_config(overrides)  # a mistake in it before one in the folder
    refuse_trained(run)
    if plan_file(run).exists():
        raise UserError(f"{run} holds a run with --refine: add --resume to go on with it, or choose another --out")


def begin_rounds(
    run: Path, rounds: int, minutes: float | None, source: Source, overrides: list[str], begin: float
) -> int:
    """The minutes are counted from `begin` on, of `time.monotonic`: they include the tracking of a video."""
    iterations, in_rounds = steps_in_time(source, overrides, rounds, minutes, time.monotonic() - begin)
    plan = Plan(rounds, source, tuple(overrides), minutes, iterations, in_rounds, time.monotonic() - begin)
    with locked(run / ROUNDS_FOLDER):
        plan.save(run)
        return train_refined(run, plan, source, begin)


def refuse_changes(run: Path, plan: Plan, arguments: Namespace, overrides: list[str]) -> None:
    """A resumed run keeps its decisions."""
    for option, was, now in (
        ("--refine", plan.rounds, arguments.refine),
        ("--minutes", plan.minutes, arguments.minutes),
    ):
        if now not in (None, was):
            began = f"without {option}" if was is None else f"with {option} {was:g}"
            raise UserError(f"{run} began {began}, not {now:g}: leave it out to resume")
    if overrides and load_config(overrides) != load_config(plan.overrides):
        began = " ".join(plan.overrides) or "no override"
        raise UserError(f"{run} began with {began}: leave the overrides out to resume, or start a new run")
    training.refuse_other_source(run, plan.source, arguments)


def moved_source(run: Path, source: Source, arguments: Namespace) -> Source:
    """The source, at its new place where the folder or the head model has moved. Raises UserError for another folder."""
    folder, head = arguments.folder, arguments.head
    if folder is not None and folder.resolve() != source.folder and source.folder.is_dir():
        raise UserError(f"{run} began on {source.folder}, not on {folder}: leave it out to resume")
    if folder is None and not source.folder.is_dir():
        raise UserError(f"{source.folder}, on which {run} began, is gone: avatar train NEW_PLACE --resume --out {run}")
    source = source if folder is None else at_new_place(source, folder.resolve())
    return source if head is None else replace(source, head=head)


def train_refined(run: Path, plan: Plan, source: Source, begin: float) -> int:
    """Train, refine, and so on, and at last train the run itself; what is done already is not done again."""
    name = safe_name(plan.source.folder.resolve().name)
    for number in range(1, plan.rounds + 1):
        stage = run / ROUNDS_FOLDER / str(number)
        if not (stage / name).is_dir():
            print(f"Round {number} of {plan.rounds}: a first avatar, and the tracking refined through it")
            status, plan = train_round(plan, source, stage, begin, plan.rounds - number)
            plan.save(run)
            if status != OK:
                return status
        # The folder knows its tracking, numbers and rate; what was let pass in the first is let pass in it.
        source = replace(source, folder=stage / name, tracking=None, frame_offset=None, format=None, fps=None)
    status = go_on_or_begin(source, plan.final_overrides(), run)
    if status == OK and plan.minutes is not None:
        print(f"Time         {(time.monotonic() - begin) / 60:.1f} of {plan.minutes:g} minutes")
    return status


def train_round(plan: Plan, source: Source, stage: Path, begin: float, to_come: int) -> tuple[int, Plan]:
    """The round in the folder `stage`, with `to_come` after it; and the plan, with the time that is gone. A round that was
    made in one sitting shows what steps take, and so how many there is time for."""
    at_once, started = not is_begun(stage / "run"), time.monotonic()
    status = go_on_or_begin(source, plan.round_overrides(), stage / "run")
    trained = time.monotonic()
    if status != OK:
        return status, replace(plan, spent=trained - begin)
    run = open_run(stage / "run", source.head, source.folder)
    status = refine_run(run, stage / safe_name(plan.source.folder.resolve().name))
    refined = time.monotonic()
    plan = replace(plan, spent=refined - begin)
    if status == OK and at_once and plan.minutes is not None:
        pace = Pace((trained - started) / plan.round_iterations, refined - trained)
        plan = plan.paced(pace, to_come, len(run.subject.split.train))
    return status, plan


def go_on_or_begin(source: Source, overrides: list[str], run: Path) -> int:
    return resume_run(run, source.head, source.folder) if is_begun(run) else train_new(source, overrides, run)


def is_begun(run: Path) -> bool:
    return (run / RUN_FILE).is_file() and bool(list_checkpoints(run / "checkpoints"))
