"""A tracked folder, prepared, with what was said about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.head.assets import load_head_assets
from data_prep.prepare.prepare import prepare


def prepare_folder(
    folder: Path, out: Path, test_frames: int | None = None, **options: Any
) -> tuple[Subject, list[str]]:
    said: list[str] = []
    head_path = folder / "head_model"
    source = Source(folder, head_path, **options)
    prepared = prepare(source, load_head_assets(head_path), out=out, test_frames=test_frames, say=said.append)
    return Subject.open(prepared), said


def edit(path: Path, section: str, **changes: np.ndarray) -> None:
    content = torch.load(path, weights_only=False)
    content[section] |= changes
    torch.save(content, path)
