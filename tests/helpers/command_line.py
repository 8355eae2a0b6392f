"""The command line, run in this process or in one of its own."""

from __future__ import annotations

import contextlib
import io
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

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


@contextlib.contextmanager
def running(*arguments: object, until: str, **options: Any) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`avatar ...` in a process of its own, and its stdout up to the line that holds `until`; killed at the end.

    `options` are of `subprocess.Popen`. Ctrl-C works, which shells ignore in what runs in their background.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "avatar.cli", *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )
    try:
        assert process.stdout is not None
        said = ""
        while until not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
        yield process, said
    finally:
        process.kill()
        process.wait()
