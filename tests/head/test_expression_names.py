"""expression_names.json as editors save it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from avatar.errors import UserError
from avatar.head.expression_names import NAMES_FILE, ExpressionNames, load_expression_names, parse_expression_names


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_names_are_read_in_every_encoding_of_json(encoding: str, tmp_path: Path) -> None:
    """Notepad and PowerShell begin a file with a mark of its byte order, or write UTF-16."""
    text = json.dumps({"names": ["lächeln", None], "arkit": {"JawOpen": {"1": 0.5}}}, ensure_ascii=False)
    (tmp_path / NAMES_FILE).write_bytes(text.encode(encoding))
    names = load_expression_names(tmp_path, 2)
    assert names.names == ("lächeln", None) and names.targets("jawOpen") == {1: 0.5}


@pytest.mark.parametrize("content", ['["lächeln"]'.encode("latin-1"), b"\xff\xfe[", b"\xef\xbb\xbf", b""])
def test_other_bytes_are_refused_by_name(content: bytes, tmp_path: Path) -> None:
    (tmp_path / NAMES_FILE).write_bytes(content)
    with pytest.raises(UserError, match=rf"{NAMES_FILE} cannot be read as JSON \("):
        load_expression_names(tmp_path, 2)


@pytest.mark.parametrize("name", ["000000000999", "00", "01", "7", "²"])
def test_numbers_of_no_coefficient_are_refused(name: str) -> None:
    with pytest.raises(UserError, match=f"moves '{name}', which is no coefficient"):
        parse_expression_names({"names": [], "arkit": {"jawOpen": {name: 1}}}, 2, "file")


@pytest.mark.parametrize("weight", [10**400, 1e300, float("nan"), "1", True])
def test_weights_that_are_no_usual_numbers_are_refused(weight: object) -> None:
    assert parse_expression_names({"names": [], "arkit": {"jawOpen": {"1": -2}}}, 2, "file").targets("jawOpen") == {
        1: -2
    }
    with pytest.raises(UserError, match="the weight of '1' in jawOpen is"):
        parse_expression_names({"names": [], "arkit": {"jawOpen": {"1": weight}}}, 2, "file")


def test_names_of_any_script_are_told_apart() -> None:
    names = ExpressionNames(("微笑", "lcheln", "lächeln", "?"))
    assert [names.index(name) for name in ("微笑", "张嘴", "Lächeln", "la\u0308cheln", "?", "#")] == [
        0,
        None,
        2,
        2,
        3,
        None,
    ]
    assert names.targets("眨眼") == {}
