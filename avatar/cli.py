"""The command line: `avatar COMMAND ...`, one subcommand for each thing that the program does."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import FrameType
from typing import NoReturn

from avatar.errors import UserError

EXIT_ERROR = 1
EXIT_INTERRUPTED = 130
_INTERRUPTED = "avatar: interrupted"


def main(argv: Sequence[str] | None = None, *, when_loaded: Callable[[], object] = lambda: None) -> int:
    """Run one command; returns the exit status. What a user can mend is printed as a sentence, without a stack trace.

    `when_loaded` is called when everything that the command needs is imported, and nothing is done yet.
    """
    try:
        # The commands import torch and the compiled core; --help must answer without them.
        from avatar.commands import find_command
        from avatar.commands.arguments import parse

        arguments = parse(argv)
        command = find_command(arguments.command)
        when_loaded()
        return command(arguments)
    except UserError as error:
        return _failed(str(error))
    except BrokenPipeError:
        return _nobody_reads()
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        return _failed(f"{place}{error.strerror or error}")
    except UnicodeEncodeError as error:
        if error.reason != "surrogates not allowed":
            raise
        return _failed(f"{error.object} has a name that is not UTF-8, which a library needs here: rename it")
    except (MemoryError, RuntimeError) as error:
        if type(error).__name__ == "OutOfMemoryError":  # torch's for a GPU, which need not be imported yet
            return _failed(
                "the GPU's memory is full: lower --size or model.uv_size, end other programs that use it, or take "
                "--device cpu"
            )
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):  # torch's word for it
            raise
        return _failed(f"there is not enough memory ({str(error).splitlines()[0] if str(error) else 'out of memory'})")
    except KeyboardInterrupt:
        with suppress(KeyboardInterrupt):
            print(_INTERRUPTED, file=sys.stderr)
        return EXIT_INTERRUPTED


def run() -> NoReturn:
    """`main` as a process of its own, in which Ctrl-C at any moment ends without a stack trace.

    While libraries are imported, an exception would come out of the middle of them, and some print it themselves; nothing
    is lost by leaving at once. At the end Python's own clearing up is as little to be interrupted by an exception.
    """
    _prepare_streams()
    try:
        interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # else it is to be ignored
        if interruptible:
            signal.signal(signal.SIGINT, _leave)
        status = main(when_loaded=lambda: interruptible and signal.signal(signal.SIGINT, signal.default_int_handler))
        if interruptible:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    except KeyboardInterrupt:  # in the moments between
        _leave(signal.SIGINT, None)
    except SystemExit as stop:  # of argparse
        status = stop.code
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        status = _nobody_reads()
    except OSError as error:
        _drop_output()
        status = status or _failed(f"the output cannot be written ({error.strerror})")
    sys.exit(status)


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


def _failed(reason: str) -> int:
    with suppress(OSError):
        print(f"avatar: {reason}", file=sys.stderr)
    return EXIT_ERROR


def _nobody_reads() -> int:
    """What was printed went to a program that has ended, such as `head`."""
    _drop_output()
    return EXIT_ERROR


def _drop_output() -> None:
    """Python flushes at the end, and would complain again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _leave(_: int, __: FrameType | None) -> NoReturn:
    os.write(2, f"{_INTERRUPTED}\n".encode())
    os._exit(EXIT_INTERRUPTED)


if __name__ == "__main__":
    run()
