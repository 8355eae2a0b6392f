"""What is written as JSON is JSON: NaN and Infinity are none, and other programs stop at them."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

from avatar.bench.results import write_report

ROOT = Path(__file__).resolve().parents[1]


def writers(path: Path) -> list[ast.Call]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return [call for call in calls if ast.unparse(call.func) in ("json.dumps", "json.dump")]


@pytest.mark.parametrize("package", ["avatar", "data_prep"])
def test_no_writer_of_json_writes_nan(package: str) -> None:
    found = [(path, call) for path in (ROOT / package).rglob("*.py") for call in writers(path)]
    without = [
        f"{path.relative_to(ROOT)}:{call.lineno}"
        for path, call in found
        if not any(word.arg == "allow_nan" and ast.unparse(word.value) == "False" for word in call.keywords)
    ]
    assert found and without == []


def test_a_benchmark_writes_null_for_what_it_did_not_measure(tmp_path: Path) -> None:
    write_report(tmp_path, "bench_some", ["table"], {"rows": [{"lpips": float("nan"), "psnr": (30.5, float("inf"))}]})
    assert json.loads((tmp_path / "bench_some.json").read_text())["rows"] == [{"lpips": None, "psnr": [30.5, None]}]
