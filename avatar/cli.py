"""The command line: `avatar COMMAND ...`, one subcommand for each thing that the program does."""

from __future__ import annotations

import io
import os
import signal
import sys
from types import FrameType
from typing import Any, NoReturn

from avatar.commands.main import EXIT_INTERRUPTED, INTERRUPTED, drop_output, end_without_reader, failed, main


def run() -> NoReturn:
    """`main` as a process of its own, in which Ctrl-C and SIGTERM at any moment end without a stack trace.

    While libraries are imported, an exception would come out of the middle of them, and some print it themselves; nothing
    is lost by leaving at once. At the end Python's own clearing up is as little to be interrupted by an exception.
    """
    _prepare_streams()
    try:
        # A signal that is to be ignored stays ignored.
        ending = {number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN}
        _handle(ending, _leave)
        status = main(when_loaded=lambda: _handle(ending, signal.default_int_handler))
        _handle(ending, signal.SIG_DFL)
    except KeyboardInterrupt:  # in the moments between
        _leave(signal.SIGINT, None)
    except SystemExit as stop:  # of argparse
        status = stop.code
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        status = end_without_reader()
    except OSError as error:
        drop_output()
        status = status or failed(f"the output cannot be written ({error.strerror})")
    sys.exit(status)


def _handle(numbers: set[signal.Signals], handler: Any) -> None:
    for number in numbers:
        signal.signal(number, handler)


def _prepare_streams() -> None:
    """Print a letter that the console does not have by its number; let closed output go nowhere, and let no file that is
    opened later get the number of a closed stream."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _leave(_: int, __: FrameType | None) -> NoReturn:
    os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(EXIT_INTERRUPTED)


if __name__ == "__main__":
    run()
