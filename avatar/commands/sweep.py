"""avatar sweep: many trainings as one."""

from __future__ import annotations

from argparse import Namespace
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from avatar.commands.outputs import check_folder_output, check_outputs
from avatar.errors import UserError
from avatar.evaluation.compare_tables import FORMATS, text, write_tables
from avatar.files.names import typed
from avatar.pipeline import INTERRUPTED, OK
from avatar.sweep.engines import EngineOptions, make_engine
from avatar.sweep.results import fold_results
from avatar.sweep.run_sweep import run_jobs
from avatar.sweep.spec import Spec, read_spec
from avatar.sweep.state import SWEEP_FILE, State, read_state, read_sweep, write_state, write_sweep
from avatar.sweep.status import Progress, full_table, overview

FAILED = 1


def run_sweep(arguments: Namespace) -> int:
    refuse_other_engines(arguments)
    folder = sweep_folder(arguments.spec, arguments.out)
    if arguments.spec is not None and not arguments.status:
        asked = read_spec(arguments.spec)
        check_sweep_folder(folder, arguments.spec, asked)
        if left := write_sweep(folder, asked):
            print(
                f"Note: {len(left)} jobs in {folder / 'jobs'}, such as {left[0]}, are not in {arguments.spec}: they are "
                "neither run nor compared, and their files stay"
            )
    spec = read_sweep(folder)
    if arguments.status:
        return show_status(folder, spec)
    if arguments.workers is not None and arguments.workers < 1:
        raise UserError(f"--workers must be at least 1, not {arguments.workers}")
    if arguments.retry_failed:
        reopen_failed(folder, spec)
    options = EngineOptions(arguments.workers, arguments.address, arguments.partition)
    engine = make_engine(arguments.engine, spec, folder, options)
    print(f"{len(spec.jobs)} jobs on {engine.name}; their files are in {folder / 'jobs'}")
    try:
        with closing(engine):
            states = run_jobs(folder, spec, engine, Progress(arguments.workers))
    except KeyboardInterrupt:
        print(f"\nInterrupted; what was done is kept. Go on with: avatar sweep --out {typed(folder)}")
        return INTERRUPTED
    write_sweep_tables(folder, spec)
    failed = [state for state in states.values() if state.status == "failed"]
    return FAILED if failed else OK


def refuse_other_engines(arguments: Namespace) -> None:
    """Raises UserError for options that the engine does not have."""
    for name, engines in (("address", ("ray", "slurm")), ("partition", ("slurm",))):
        if getattr(arguments, name) is not None and arguments.engine not in engines:
            raise UserError(f"--{name} is for --engine {' or '.join(engines)}, not for {arguments.engine}")


def sweep_folder(spec: Path | None, out: Path | None) -> Path:
    if out is not None:
        return out
    if spec is None:
        raise UserError("say which sweep: avatar sweep SPEC.yaml, or avatar sweep --out DIR to go on with one")
    return Path("runs") / spec.stem


def check_sweep_folder(folder: Path, file: Path, spec: Spec) -> None:
    """Raise UserError where a sweep would write over its file, or into what its jobs train on."""
    keys = ("folder", "head", "tracking")
    inputs = {Path(job.source[key]) for job in spec.jobs for key in keys if key in job.source}
    check_folder_output(folder, sorted(inputs))
    check_outputs([folder / SWEEP_FILE], [file])


def show_status(folder: Path, spec: Spec) -> int:
    states = {job.name: read_state(folder / "jobs" / job.name) for job in spec.jobs}
    print("\n".join([*overview(states), "", *full_table(states)]))
    return FAILED if any(state.status == "failed" for state in states.values()) else OK


def reopen_failed(folder: Path, spec: Spec) -> None:
    for job in spec.jobs:
        place = folder / "jobs" / job.name
        state = read_state(place)
        if state.status == "failed":
            write_state(place, replace(State(), seconds=state.seconds))


def write_sweep_tables(folder: Path, spec: Spec) -> None:
    """The table on the terminal, and in every format in files, as far as there are results."""
    try:
        comparison = fold_results(folder, spec)
    except UserError as error:
        print(f"No table: {error}")
        return
    write_tables(folder, comparison)
    print(text(comparison), end="")
    print(f"Tables {folder / 'compare'}.{{{','.join(suffix for suffix, _ in FORMATS.values())}}}")
