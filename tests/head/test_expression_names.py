"""expression_names.json as editors save it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from avatar.errors import UserError
from avatar.head.expression_names import NAMES_FILE, load_expression_names


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
