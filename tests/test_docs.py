"""The documentation's commands parse, its links and the pages that the code names exist, and its pages stay short."""

from __future__ import annotations

import csv
import re
import shlex
from pathlib import Path

import pytest

from avatar.commands.arguments import parse
from avatar.commands.groups import GROUPS
from avatar.config import load_config

COMMANDS = [name for group in GROUPS.values() for name in group]
ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
LINKING = sorted([*PAGES, *(ROOT / "docs" / "bench").glob("*.md")])


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


@pytest.mark.parametrize("page", LINKING, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target, _, anchor in re.findall(r"\]\(([^)#]*)(#([^)]*))?\)", page.read_text(encoding="utf-8")):
        if target.startswith("http"):
            continue
        file = page.parent / target if target else page
        assert file.exists(), f"{page.name} links to {target}"
        assert not anchor or anchor in anchors(file), f"{page.name} links to {target}#{anchor}"


def anchors(page: Path) -> set[str]:
    """What a page's headings are linked by."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_files_that_code_and_pages_name_exist() -> None:
    named = re.compile(
        r"\b(?:avatar|data_prep|scripts|tests|configs|docs)/[\w/]+\.(?:py|js|cpp|h|sh|toml|yaml|md|csv)\b"
    )
    for folder in ("avatar", "data_prep", "scripts", "configs", "docs"):
        for file in (ROOT / folder).rglob("*"):
            if file.suffix in {".py", ".h", ".cpp", ".yaml", ".sh", ".js", ".md"}:
                for name in named.findall(file.read_text(encoding="utf-8")):
                    assert (ROOT / name).exists(), f"{file.relative_to(ROOT)} names {name}"


def test_pages_stay_short() -> None:
    words = {page.name: len(page.read_text(encoding="utf-8").split()) for page in PAGES}
    assert words["README.md"] <= 500 and words["recipe.md"] <= 400
    assert sum(words.values()) - words["README.md"] <= 7000, words


def test_experiments_have_figures_that_can_be_read() -> None:
    with (ROOT / "docs" / "experiments.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file, strict=True))
    assert list(rows[0]) == ["change", "data", "seeds", "dpsnr", "dssim", "dlpips", "kept", "command"]
    for row in rows:
        assert row["change"] and row["kept"] in ("yes", "no", ""), row
        for name in ("dpsnr", "dssim", "dlpips"):
            assert re.fullmatch(r"([+-]\d+\.\d+|0(\.0+)?)?", row[name]), row


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_named_tests_exist(page: Path) -> None:
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    for name in re.findall(r"`(test_\w+)`", page.read_text(encoding="utf-8")):
        assert f"def {name}(" in sources, f"{page.name} names {name}"


def test_the_readme_shows_the_two_commands() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "make demo" in text and "make test" in text
