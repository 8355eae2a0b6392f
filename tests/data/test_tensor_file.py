"""Files of tensors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from avatar.data import tensor_file
from avatar.data.tensor_file import read_tensors
from avatar.errors import UserError


def test_a_file_larger_than_the_free_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "some.safetensors"
    save_file({"numbers": torch.arange(100.0)}, path)
    size = path.stat().st_size
    monkeypatch.setattr(tensor_file, "available_bytes", lambda: size)
    assert torch.equal(read_tensors(path, 2**20)["numbers"], torch.arange(100.0))
    monkeypatch.setattr(tensor_file, "available_bytes", lambda: size - 1)
    with pytest.raises(UserError, match="of memory are free"):
        read_tensors(path, 2**20)
