"""avatar completion: what a shell needs to complete commands, their options and keys of the configuration."""

from __future__ import annotations

import argparse
from argparse import Namespace

from avatar.commands.groups import GROUPS
from avatar.commands.parser import build_parser
from avatar.config import declared_keys
from avatar.pipeline import OK

BASH = """_avatar() {{
  local words="" current="${{COMP_WORDS[COMP_CWORD]}}"
  if [ "$COMP_CWORD" -eq 1 ]; then words="{commands}"; else
    case "${{COMP_WORDS[1]}} ${{COMP_WORDS[COMP_CWORD-1]}}" in
{cases}
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$current"))
  case "$COMPREPLY" in *=) compopt -o nospace 2>/dev/null ;; esac
}}
complete -o default -F _avatar avatar
"""


def run_completion(arguments: Namespace) -> int:
    if arguments.shell == "fish":
        print("\n".join(fish_lines()))
    else:
        print("autoload -U +X bashcompinit && bashcompinit\n" * (arguments.shell == "zsh") + bash_script(), end="")
    return OK


def bash_script() -> str:
    """For bash, and for zsh with its bashcompinit; paths complete where no word of ours does."""
    cases = []
    for name, parser in parsers().items():
        actions = options(parser)
        for action in actions:
            if action.choices:
                patterns = "|".join(f'"{name} {option}"' for option in action.option_strings)
                cases.append(f'      {patterns}) words="{" ".join(map(str, action.choices))}" ;;')
        words = (
            [option for action in actions for option in action.option_strings] + key_words(name) + positional(parser)
        )
        cases.append(f'      "{name} "*) words="{" ".join(words)}" ;;')
    return BASH.format(commands=" ".join(parsers()), cases="\n".join(cases))


def fish_lines() -> list[str]:
    meanings = {name: meaning for group in GROUPS.values() for name, (meaning, _) in group.items()}
    lines = []
    for name, parser in parsers().items():
        here = f"complete -c avatar -n '__fish_seen_subcommand_from {name}'"
        lines.append(f"complete -c avatar -n __fish_use_subcommand -f -a {name} -d {quoted(meanings[name])}")
        for action in options(parser):
            long = [option[2:] for option in action.option_strings if option.startswith("--")]
            takes = "" if action.nargs == 0 else " -r"
            choices = f" -f -a {quoted(' '.join(map(str, action.choices)))}" if action.choices else ""
            lines.append(f"{here} -l {long[-1]}{takes}{choices}")
        words = key_words(name) + positional(parser)
        lines += [f"{here} -a {quoted(' '.join(words))}"] if words else []
    return lines


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Of the commands that are for people."""
    _, commands = build_parser()
    return {name: commands[name] for group in GROUPS.values() for name in group}


def options(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    return [action for action in parser._actions if action.option_strings]  # argparse tells them in no other way


def positional(parser: argparse.ArgumentParser) -> list[str]:
    return [str(word) for action in parser._actions if not action.option_strings for word in action.choices or ()]


def key_words(command: str) -> list[str]:
    return [f"{key}=" for key in ("model", "experiment", *declared_keys())] if command == "train" else []


def quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
