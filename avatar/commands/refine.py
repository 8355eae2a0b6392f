"""avatar refine: tracking refined through a trained avatar."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from avatar.commands.outputs import check_folder_output
from avatar.files.names import typed
from avatar.pipeline import OK
from avatar.pipeline.open_inputs import open_run
from avatar.pipeline.refine_run import REFINED_FOLDER, refine_run


def run_refine(arguments: Namespace) -> int:
    run = open_run(arguments.run, arguments.head, arguments.folder)
    target: Path = arguments.out or arguments.run / REFINED_FOLDER / run.subject.name
    check_folder_output(target, [Path(run.subject.manifest.source)])
    status = refine_run(run, target, arguments.device or "auto")
    if status == OK:
        print(f"Next         avatar train {typed(target)} --out ANOTHER_RUN")
    return status
