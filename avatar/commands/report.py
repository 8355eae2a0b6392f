"""avatar report: one page about a run."""

from __future__ import annotations

from argparse import Namespace

from avatar.pipeline import OK
from avatar.pipeline.open_inputs import open_run


def run_report(arguments: Namespace) -> int:
    from avatar.report.page import write_report

    print(f"Report {write_report(open_run(arguments.run, arguments.head, arguments.folder))}")
    return OK
