"""avatar train --refine N: training and refinement in turns, and then the run itself.

RUN/rounds/plan.json      what the rounds began with
RUN/rounds/1/run          a first, shorter training
RUN/rounds/1/NAME         the subject, refined through its avatar: what the next round, or the run itself, trains on
"""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

from avatar.commands import OK, training
from avatar.commands.opening import open_run, source_of
from avatar.commands.refining import refine_run
from avatar.commands.training import resume_run, train_new
from avatar.config import load_config
from avatar.data.source import Source
from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.runs.checkpoint import list_checkpoints
from avatar.runs.run import RUN_FILE, refuse_trained

ROUNDS_FOLDER = "rounds"
PLAN_FORMAT = 1
MAX_ROUNDS = 10
# Of the iterations: an avatar that has seen enough to tell where a head is.
FIRST_SHARE = 0.4


@dataclass(frozen=True)
class Plan:
    """What `avatar train --refine` was asked for."""

    rounds: int
    source: Source
    overrides: tuple[str, ...]

    def save(self, run: Path) -> None:
        content = {"format": PLAN_FORMAT, "rounds": self.rounds, "source": self.source.to_dict()}
        write_atomically(plan_file(run), json.dumps({**content, "overrides": self.overrides}, indent=1).encode())

    @classmethod
    def load(cls, run: Path) -> Plan:
        """Raises UserError for a file that `save` did not write."""
        path = plan_file(run)
        try:
            raw = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise UserError(f"{path} cannot be read ({error})") from None
        if not isinstance(raw, dict) or raw.get("format") != PLAN_FORMAT:
            raise UserError(f"{path} was written by another version of this program; start a new run")
        rounds, overrides = raw.get("rounds"), raw.get("overrides")
        if (
            not isinstance(rounds, int)
            or not isinstance(overrides, list)
            or not all(isinstance(o, str) for o in overrides)
        ):
            raise UserError(f"{path} is damaged (rounds or overrides); start a new run")
        return cls(rounds, Source.from_dict(raw.get("source")), tuple(overrides))


def plan_file(run: Path) -> Path:
    return run / ROUNDS_FOLDER / "plan.json"


def run_train(arguments: Namespace) -> int:
    """With rounds where they are asked for, or were when the run began; else `training`."""
    run = arguments.out or training.default_run(arguments.folder)
    overrides = training.config_overrides(arguments)
    if arguments.resume and plan_file(run).exists():
        plan = Plan.load(run)
        refuse_changes(run, plan, arguments, overrides)
        return train_refined(run, plan)
    if arguments.refine is None:
        return training.run_train(arguments)
    if arguments.resume:
        raise UserError(f"{run} began without --refine: leave it out to resume, or start a new run")
    return begin_rounds(run, arguments.refine, source_of(arguments), overrides)


def begin_rounds(run: Path, rounds: int, source: Source, overrides: list[str]) -> int:
    """Raises UserError where the folder holds a run, or rounds, already."""
    if not 1 <= rounds <= MAX_ROUNDS:
        raise UserError(f"--refine must be from 1 to {MAX_ROUNDS}, not {rounds}")
    load_config(overrides)  # a mistake in it before one in the folder
    refuse_trained(run)
    if plan_file(run).exists():
        raise UserError(f"{run} holds a run with --refine: add --resume to go on with it, or choose another --out")
    plan = Plan(rounds, source, tuple(overrides))
    plan.save(run)
    return train_refined(run, plan)


def refuse_changes(run: Path, plan: Plan, arguments: Namespace, overrides: list[str]) -> None:
    """A resumed run keeps its decisions."""
    if arguments.refine not in (None, plan.rounds):
        raise UserError(f"{run} began with --refine {plan.rounds}, not {arguments.refine}: leave it out to resume")
    if overrides and load_config(overrides) != load_config(plan.overrides):
        began = " ".join(plan.overrides) or "no override"
        raise UserError(f"{run} began with {began}: leave the overrides out to resume, or start a new run")
    if arguments.folder is not None and arguments.folder.resolve() != plan.source.folder:
        raise UserError(f"{run} began on {plan.source.folder}, not on {arguments.folder}: leave it out to resume")


def train_refined(run: Path, plan: Plan) -> int:
    """Train, refine, and so on, and at last train the run itself; what is done already is not done again."""
    name = plan.source.folder.resolve().name
    iterations = load_config(plan.overrides).trainer.iterations
    shorter = [*plan.overrides, f"trainer.iterations={max(1, round(FIRST_SHARE * iterations))}"]
    source = plan.source
    for number in range(1, plan.rounds + 1):
        stage = run / ROUNDS_FOLDER / str(number)
        if not (stage / name).is_dir():
            print(f"Round {number} of {plan.rounds}: a first avatar, and the tracking refined through it")
            status = go_on_or_begin(source, shorter, stage / "run")
            if status == OK:
                status = refine_run(open_run(stage / "run", source.head), stage / name)
            if status != OK:
                return status
        source = Source(stage / name, source.head, max_left_out=source.max_left_out)
    return go_on_or_begin(source, list(plan.overrides), run)


def go_on_or_begin(source: Source, overrides: list[str], run: Path) -> int:
    begun = (run / RUN_FILE).is_file() and list_checkpoints(run / "checkpoints")
    return resume_run(run, source.head) if begun else train_new(source, overrides, run)
