"""avatar compare: figures of runs side by side."""

from __future__ import annotations

import sys
from argparse import Namespace

from avatar.commands.outputs import check_folder_output
from avatar.evaluation.compare import compare_runs
from avatar.evaluation.compare_tables import FORMATS, write_tables
from avatar.pipeline import OK


def run_compare(arguments: Namespace) -> int:
    if arguments.out is not None:
        check_folder_output(arguments.out, [])
    comparison = compare_runs(arguments.runs, arguments.protocol)
    if arguments.out is not None:
        write_tables(arguments.out, comparison)
        print(f"Written to {arguments.out}", file=sys.stderr)  # the table may be piped
    _, table = FORMATS[arguments.format]
    print(table(comparison), end="")
    return OK
