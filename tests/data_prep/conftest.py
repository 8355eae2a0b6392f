"""The small tracked folder that the other formats are written from, and its subject."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from importing import FRAMES, HEIGHT, SIZE, import_folder
from tracked_folder import write_tracked_folder

from avatar.data.subject import Subject


@pytest.fixture(scope="session")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small tracked folder without eyelids, which the other formats do not have."""
    folder = tmp_path_factory.mktemp("formats") / "someone"
    write_tracked_folder(folder, FRAMES, SIZE, height=HEIGHT, suffix=".png")
    for path in (folder / "checkpoint").iterdir():
        content = torch.load(path, weights_only=False)
        content["flame"]["eyelids"][:] = 0
        torch.save(content, path)
    return folder


@pytest.fixture(scope="session")
def original(tracked: Path, tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return import_folder(tracked, tracked, tmp_path_factory.mktemp("prepared") / "out")[0]
