"""The command line, run in this process."""

from __future__ import annotations

import contextlib
import io

from avatar.cli import main


def avatar(*arguments: object, status: int = 0) -> str:
    """Run `avatar ...`; returns stdout and stderr together after checking the exit status."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            returned = main([str(argument) for argument in arguments])
        except SystemExit as stop:  # argparse: --help, --version, usage
            returned = int(stop.code or 0)
    assert returned == status, output.getvalue().encode(errors="replace").decode()  # pytest-xdist sends UTF-8 alone
    return output.getvalue()
