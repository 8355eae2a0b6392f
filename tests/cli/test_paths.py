"""Paths with a = in their names, which key=value has too."""

from __future__ import annotations

from pathlib import Path

import pytest

from avatar.commands.arguments import parse


@pytest.mark.parametrize("given", ["a=b", "./a=b", "./model=flashavatar", "{}/a=b"])
def test_a_folder_with_an_equals_sign_in_its_name_is_a_folder(
    given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a=b", "model=flashavatar"):
        (tmp_path / name).mkdir()
    given = given.format(tmp_path)
    for words in (["train", given, "trainer.seed=3"], ["train", "trainer.seed=3", "--size", "64", given]):
        arguments = parse(words)
        assert arguments.paths == [Path(given)] and arguments.overrides == ["trainer.seed=3"]
    assert parse(["bench", "train", given, "trainer.seed=3"]).inputs == [Path(given)]


def test_a_path_that_is_not_there_is_a_path_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = parse(["train", "./c=d", "model=flashavatar"])
    assert arguments.paths == [Path("c=d")] and arguments.overrides == ["model=flashavatar"]
