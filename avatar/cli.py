"""The command line: `avatar COMMAND ...`, one subcommand for each thing that the program does."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from avatar.errors import UserError

EXIT_ERROR = 1
EXIT_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status. A UserError is printed as its sentence, without a stack trace."""
    try:
        # The commands import torch and the compiled core; --help must answer without them.
        from avatar.commands import run_command
        from avatar.commands.parser import parse

        return run_command(parse(argv))
    except UserError as error:
        print(f"avatar: {error}", file=sys.stderr)
        return EXIT_ERROR
    except RuntimeError as error:
        if type(error).__name__ != "OutOfMemoryError":  # torch's, which need not be imported yet
            raise
        print(
            "avatar: the GPU's memory is full: lower --size or model.uv_size, end other programs that use it, or take "
            "--device cpu",
            file=sys.stderr,
        )
        return EXIT_ERROR
    except KeyboardInterrupt:
        print("avatar: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
