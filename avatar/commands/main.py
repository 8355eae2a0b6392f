"""One command, as it was typed: its exit status, and what a user can mend as a sentence."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress

from avatar.commands import find_command
from avatar.commands.arguments import parse, refuse_missing
from avatar.compute.processors import limit_threads
from avatar.errors import UserError

EXIT_ERROR = 1
EXIT_INTERRUPTED = 130
INTERRUPTED = "avatar: interrupted"


def main(argv: Sequence[str] | None = None, *, when_loaded: Callable[[], object] = lambda: None) -> int:
    """Run one command; returns the exit status. What a user can mend is printed as a sentence, without a stack trace.

    `when_loaded` is called when everything that the command needs is imported, and nothing is done yet.
    """
    try:
        arguments = parse(argv)
        refuse_missing(arguments)
        limit_threads()
        command = find_command(arguments.command)
        when_loaded()
        return command(arguments)
    except UserError as error:
        return failed(str(error))
    except BrokenPipeError:
        return end_without_reader()
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        return failed(f"{place}{error.strerror or error}")
    except UnicodeEncodeError as error:
        if error.reason != "surrogates not allowed":
            raise
        return failed(f"{error.object} has a name that is not UTF-8, which a library needs here: rename it")
    except ValueError as error:
        if not str(error).startswith("AVATAR_"):  # the kernels' word for a variable that holds nonsense
            raise
        return failed(str(error))
    except (MemoryError, RuntimeError) as error:
        if type(error).__name__ == "OutOfMemoryError":  # torch's for a GPU, which need not be imported yet
            return failed(
                "the GPU's memory is full: lower --size or model.uv_size, end other programs that use it, or take "
                "--device cpu"
            )
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):  # torch's word for it
            raise
        return failed(f"there is not enough memory ({str(error).splitlines()[0] if str(error) else 'out of memory'})")
    except KeyboardInterrupt:
        with suppress(KeyboardInterrupt):
            print(INTERRUPTED, file=sys.stderr)
        return EXIT_INTERRUPTED


def failed(reason: str) -> int:
    with suppress(OSError):
        print(f"avatar: {reason}", file=sys.stderr)
    return EXIT_ERROR


def end_without_reader() -> int:
    """What was printed went to a program that has ended, such as `head`."""
    drop_output()
    return EXIT_ERROR


def drop_output() -> None:
    """Python flushes at the end, and would complain again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
