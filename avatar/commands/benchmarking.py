"""avatar bench: time and error of a part on this machine."""

from __future__ import annotations

from argparse import Namespace
from importlib import import_module
from pathlib import Path

from avatar.bench import PARTS, Request
from avatar.commands import OK
from avatar.commands.outputs import check_folder_output, check_outputs
from avatar.errors import UserError


def run_bench(arguments: Namespace) -> int:
    out: Path = arguments.out
    check_folder_output(out)
    check_outputs([out], [*arguments.inputs, arguments.head, arguments.tracking])
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be made ({error.strerror}); choose another --out") from error
    request = Request(
        out,
        arguments.quick,
        arguments.full,
        tuple(arguments.inputs),
        tuple(arguments.overrides),
        arguments.head,
        arguments.tracking,
        arguments.frame_offset,
    )
    # Only the part that is asked for is imported.
    import_module(PARTS[arguments.part].module).run(request)
    return OK
