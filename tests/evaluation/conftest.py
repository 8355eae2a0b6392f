"""Evaluations of the disc instead of a trained avatar."""

from __future__ import annotations

from pathlib import Path

import pytest
from disc import BlobRenderer, make_subject

from avatar.data.subject import Subject
from avatar.evaluation import evaluate as evaluate_module


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("AVATAR_LPIPS", raising=False)
    monkeypatch.setattr(evaluate_module, "Renderer", BlobRenderer)


@pytest.fixture
def subject(tmp_path: Path) -> Subject:
    return make_subject(tmp_path)
