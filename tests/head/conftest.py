"""What the tests of head models share."""

from __future__ import annotations

import pytest

from avatar.demo.head import demo_head
from avatar.demo.head_files import write_head_model
from avatar.head.assets import HeadAssets, load_head_assets


@pytest.fixture(scope="session")
def assets(tmp_path_factory: pytest.TempPathFactory) -> HeadAssets:
    """The demo's head model, as it is read from its files."""
    folder = tmp_path_factory.mktemp("head")
    write_head_model(folder, demo_head())
    return load_head_assets(folder)
