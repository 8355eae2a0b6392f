"""avatar eval, report and compare: figures of trained avatars."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avatar.commands import OK
from avatar.commands.opening import open_run
from avatar.commands.outputs import check_folder_output, check_outputs
from avatar.compute.choose import choose_device
from avatar.errors import UserError
from avatar.evaluation.compare import compare_runs
from avatar.evaluation.compare_tables import FORMATS, write_tables
from avatar.evaluation.evaluate import evaluate
from avatar.evaluation.protocol import choose_protocols
from avatar.files.lock import locked


def run_eval(arguments: Namespace) -> int:
    run = open_run(arguments.run, arguments.head, arguments.folder)
    run.avatar.to(choose_device(arguments.device or "auto", print))
    with writing_figures(run.path):
        results = evaluate(run, arguments.protocol, write_frames=arguments.frames or arguments.verify)
        if arguments.verify:
            from avatar.evaluation.verify import verify  # imports scikit-image, which nothing else here needs

            verify(results, [protocol.name for protocol in choose_protocols(arguments.protocol)])
    return OK


@contextmanager
def writing_figures(run: Path) -> Iterator[None]:
    """RUN/eval for this process alone. Raises UserError where another evaluates the run, or the disk refuses."""
    folder, otherwise = run / "eval", "free some space, or copy the run to a place that can be written"
    with locked(folder, otherwise):
        try:
            yield
        except OSError as error:
            raise UserError(f"{folder} cannot be written ({error.strerror or error}); {otherwise}") from error


def run_report(arguments: Namespace) -> int:
    from avatar.report.page import write_report

    print(f"Report {write_report(open_run(arguments.run, arguments.head, arguments.folder))}")
    return OK


def run_compare(arguments: Namespace) -> int:
    if arguments.out is not None:
        check_folder_output(arguments.out)
        check_outputs([arguments.out], [])
    comparison = compare_runs(arguments.runs, arguments.protocol)
    if arguments.out is not None:
        write_tables(arguments.out, comparison)
        print(f"Written to {arguments.out}", file=sys.stderr)  # the table may be piped
    _, table = FORMATS[arguments.format]
    print(table(comparison), end="")
    return OK
