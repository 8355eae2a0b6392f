"""What was typed after `avatar`, as the arguments of one command."""

from __future__ import annotations

import argparse
import difflib
import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from avatar.bench import PARTS
from avatar.commands.parser import build_parser
from avatar.errors import UserError
from avatar.files.read import is_there

INPUTS = ("run", "runs", "folder", "videos", "paths", "inputs", "driver", "spec")  # paths that are read
LISTS_MISTAKES = ("check", "create")  # these commands say everything that is wrong at once
KEY = re.compile(r"[+~]*[A-Za-z_][\w.]*")  # Hydra's own signs are no part of our keys, and refused as such


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The arguments of one command. Folders and `key=value` overrides may stand anywhere among its options.

    Without a command, prints the help and exits with status 0. Exits with status 2 and the usage, as argparse does, on
    anything that it does not know.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    parser, commands = build_parser()
    if not words:
        parser.print_help()
        parser.exit()
    name = next((word for word in words if not word.startswith("-")), None)
    if name is not None and name not in commands:
        parser.error(f"there is no command '{name}'{nearest(name, commands)}; avatar --help lists them")
    for word in words[1:]:
        if word.startswith("-") and "." in word and os.path.exists(word):  # noqa: PTH110 (as below)
            parser.error(f"{word} is read as an option: write ./{word} for the file")
    arguments, rest = parser.parse_known_args(words)
    takes_words = "words" in arguments
    unknown = [word for word in rest if word.startswith("-") or not takes_words]
    if unknown:
        known = re.findall(r"--[a-z-]+", commands[arguments.command].format_help())
        hint = nearest(unknown[0].partition("=")[0], known) if unknown[0].startswith("--") else ""
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    if takes_words:
        arguments.words += rest
        SORTED_BY[arguments.command](commands[arguments.command], arguments)
    return arguments


def refuse_missing(arguments: argparse.Namespace) -> None:
    """Raises UserError for an input that nothing has the name of, and for an override of no key or a wrong value: before
    the command is imported, which takes seconds."""
    if arguments.command in LISTS_MISTAKES:
        return
    for value in (getattr(arguments, name, None) for name in INPUTS):
        for path in value if isinstance(value, list) else [value]:
            if isinstance(path, Path) and not is_there(path):
                raise UserError(f"{path} does not exist")
    if getattr(arguments, "overrides", None):
        from avatar.config import load_config  # imports hydra

        load_config(arguments.overrides)


def nearest(word: str, known: Iterable[str] | Mapping[str, object]) -> str:
    found = difflib.get_close_matches(word.lower(), known, n=1)
    return f"; the nearest is {found[0]}" if found else ""


def is_override(word: str) -> bool:
    """Whether a word is `key=value`. A path may have `=` in its name: a file or folder that exists is a path, unless what
    is before the `=` is a key of the configuration."""
    key, sign, _ = word.partition("=")
    if not sign or not KEY.fullmatch(key):
        return False
    if not os.path.exists(word):  # noqa: PTH110 (Path.exists raises for a name that is too long)
        return True
    from avatar.config import chosen_options, flatten, load_config  # imports hydra

    return key in chosen_options() or key in flatten(load_config().to_dict())


def sort_words(arguments: argparse.Namespace) -> list[Path]:
    """The paths among a command's words; the others become its overrides."""
    arguments.overrides = [word for word in arguments.words if is_override(word)]
    return [Path(word) for word in arguments.words if not is_override(word)]


def sort_train(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """SUBJECT and, with --resume, RUN. Which of the two a single path is then, the folder itself says."""
    arguments.paths = sort_words(arguments)
    given = len(arguments.paths)
    if arguments.resume and given > 2:
        parser.error(f"train --resume takes a RUN, and its SUBJECT where that has moved; {given} paths are given")
    if not arguments.resume and (given > 1 or not (given or arguments.print_config)):
        parser.error(f"train takes one SUBJECT, {given} given")


def sort_reenact(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """DRIVER, with --driver or without."""
    drivers = [*map(Path, arguments.words), *([] if arguments.driver is None else [arguments.driver])]
    if len(drivers) != 1:
        parser.error(f"reenact takes one DRIVER after the AVATAR, {len(drivers)} given")
    (arguments.driver,) = drivers


def sort_bench(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Each part of the benchmark takes a number of folders of its own."""
    arguments.inputs = sort_words(arguments)
    given, inputs = len(arguments.inputs), PARTS[arguments.part].inputs
    most = len(inputs.split())
    if given < most - inputs.count("[") or (given > most and "..." not in inputs):
        parser.error(f"bench {arguments.part} takes {inputs or 'no folder'}, {given} given")


SORTED_BY = {"train": sort_train, "reenact": sort_reenact, "bench": sort_bench}
