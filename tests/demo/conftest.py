"""The demo person filmed by three cameras, once for all tests."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
from listed_views import CAMERAS, FRAMES, SEED, SIZE

from avatar.cli import main
from avatar.head.assets import HeadAssets, load_head_assets


@pytest.fixture(scope="session")
def printed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out, said = tmp_path_factory.mktemp("cameras") / "someone", StringIO()
    options = ["--cameras", CAMERAS, "--frames", FRAMES, "--size", SIZE, "--seed", SEED]
    with redirect_stdout(said):
        assert main(["demo-data", str(out), *map(str, options)]) == 0
    return out, said.getvalue()


@pytest.fixture(scope="session")
def camera_folder(printed: tuple[Path, str]) -> Path:
    return printed[0]


@pytest.fixture(scope="session")
def assets(camera_folder: Path) -> HeadAssets:
    return load_head_assets(camera_folder / "FREE" / "head_model")
