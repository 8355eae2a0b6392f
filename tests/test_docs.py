"""Every command that the documentation shows must parse, and every file that it links to must exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from avatar.commands.arguments import parse
from avatar.config import load_config

COMMANDS = (
    "train",
    "eval",
    "refine",
    "compare",
    "reenact",
    "export",
    "view",
    "send",
    "drive-file",
    "report",
    "check",
    "prepare",
    "demo-data",
    "demo",
    "bench",
    "track",
    "models",
)
ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])


def commands(page: Path) -> list[str]:
    fenced = re.findall(r"```[a-z]*\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    lines = [line.split("  #")[0].strip() for block in fenced for line in block.splitlines()]
    inline = re.findall(r"`(avatar [^`]+)`", page.read_text(encoding="utf-8"))
    return [line.removeprefix("$ ") for line in [*lines, *inline] if line.removeprefix("$ ").startswith("avatar ")]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_documented_commands_parse(page: Path) -> None:
    for command in commands(page):
        if command.split()[1].isupper() or "|" in command:
            continue  # a pattern, not a command
        words = shlex.split(command)[1:]
        if len(words) == 1 and words[0] in COMMANDS:
            words.append("--help")  # a mention of the command itself
        try:
            arguments = parse(words)
        except SystemExit as stop:
            assert stop.code == 0, f"{page.name}: {command}"
        else:
            load_config(getattr(arguments, "overrides", []))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_named_tests_exist(page: Path) -> None:
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    for name in re.findall(r"`(test_\w+)`", page.read_text(encoding="utf-8")):
        assert f"def {name}(" in sources, f"{page.name} names {name}"


def test_the_readme_shows_the_two_commands() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "make demo" in text and "make test" in text
