"""The small tracked folder that the other formats are written from, and its subject; what tests that look at faces need.

MediaPipe and its published models: without them such tests are skipped with the reason.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from importing import FRAMES, HEIGHT, SIZE, import_folder
from tracked_folder import write_tracked_folder

from avatar.data.subject import Subject
from avatar.demo.head import demo_head
from avatar.demo.head_files import write_head_model
from avatar.files.third_party import FACE_LANDMARKER, FOLDER_VARIABLE, SELFIE_SEGMENTATION, find


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


@pytest.fixture(scope="session")
def tracking_models() -> Iterator[None]:
    """The published models, from where the person keeps them, else from the development data beside the checkout."""
    if importlib.util.find_spec("mediapipe") is None:
        pytest.skip("MediaPipe is not installed: pip install '.[track]'")
    shared = Path(__file__).resolve().parents[3] / "shared" / "assets"
    with pytest.MonkeyPatch.context() as patch:
        if find(FACE_LANDMARKER) is None and shared.is_dir():
            patch.setenv(FOLDER_VARIABLE, str(shared))
        missing = [file.name for file in (FACE_LANDMARKER, SELFIE_SEGMENTATION) if find(file) is None]
        if missing:
            pytest.skip(f"{' and '.join(missing)} missing: avatar models --download")
        yield


@pytest.fixture(scope="session")
def demo_head_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("head") / "head_model"
    write_head_model(folder, demo_head())
    return folder
