"""Names of folders that tell people what is inside."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from avatar.files.names import display_name, display_path, typed


@pytest.mark.parametrize(
    ("folder", "expected"),
    [
        ("/films/me/subject", "me/subject"),
        ("/films/me/run", "me/run"),
        ("/films/me/run/rounds/1/run", "me/run/rounds/1/run"),
        ("/films/me/run/rounds/2/subject", "me/run/rounds/2/subject"),
        ("/runs/anna/rounds/1/anna", "anna"),
        ("/nersemble/017/subject/", "017/subject"),
        ("/runs/anna", "anna"),
        ("/run", "run"),
        ("/", "/"),
    ],
)
def test_the_end_of_a_path_begins_with_a_name_that_a_person_gave(folder: str, expected: str) -> None:
    assert display_path(Path(folder)) == Path(expected)
    assert display_name(Path(folder)) == Path(expected).parts[0]
    assert display_name(Path()) == ""


@pytest.mark.parametrize("name", ["runs/me", "my runs/r=1 ü", "it's", "-v", "$HOME; ls"])
def test_a_printed_command_can_be_typed(name: str) -> None:
    assert shlex.split(f"avatar eval {typed(Path(name))}") == ["avatar", "eval", name]
    assert typed(Path("runs/me")) == "runs/me"
