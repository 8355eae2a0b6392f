"""The code of docs/api.md and of the notebook runs as it stands."""

from __future__ import annotations

import ast
import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from command_line import avatar
from PIL import Image
from small_runs import train_small
from tracked_folder import write_tracked_folder

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE, NOTEBOOK = DOCS / "api.md", DOCS / "avatar.ipynb"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a tracked folder and the run of its avatar."""
    place = tmp_path_factory.mktemp("place")
    folder = write_tracked_folder(place / "someone", frames=330, size=24)
    train_small(folder, place / "runs" / "anna", ["trainer.iterations=2"])
    return place


def test_the_code_runs(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "runs").symlink_to(place / "runs")
    shutil.copytree(place / "someone" / "head_model", tmp_path / "head_model")
    (tmp_path / "motion.csv").write_text("time,expression_0,jaw_x,jaw_y,jaw_z\n0,0,0,0,0\n0.1,0.5,0.1,0,0\n")
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) == 2 and len(blocks[0].splitlines()) <= 12
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    for block in blocks:
        exec(compile(block.replace("size=512", "size=48"), str(PAGE), "exec"), found)
    assert found["picture"].shape == (24, 24, 3) and found["rendering"].image.shape == (48, 48, 3)
    assert len(found["gaussians"].means) == len(found["anna"].avatar)
    assert len(found["pictures"]) == 2 and not torch.equal(*found["pictures"])
    assert found["far"].dtype == torch.bool


def test_the_notebook_runs(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cells, without the outputs that Jupyter would show and keep."""
    avatar("export", place / "runs" / "anna", "--out", tmp_path / "me.safetensors", "--with-head")
    cells = [cell for cell in json.loads(NOTEBOOK.read_bytes())["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] or cell["execution_count"] for cell in cells)
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    shown = []
    for cell in cells:
        *lines, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(lines, []), str(NOTEBOOK), "exec"), found)
        assert isinstance(last, ast.Expr)
        shown.append(eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), found))
    pictures = [value._repr_png_() for value in shown if hasattr(value, "_repr_png_")]
    assert len(pictures) == 3 and all(data.startswith(b"\x89PNG") for data in pictures)
    assert Image.open("me.gif").n_frames > 12 and Image.open("me.png").size == (512, 512)
