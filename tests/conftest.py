"""Fixtures shared by all tests."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from array_shapes import any_shapes, install_array_checks  # noqa: F401 (a fixture)

install_array_checks()

from tracked_folder import write_tracked_folder  # noqa: E402


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture
def two_threads() -> Iterator[None]:
    """`make test` gives torch one, and users more."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def ctrl_c_works() -> Iterator[None]:
    """SIGINT is ignored where the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The development data beside the checkout; tests that need it are skipped where it is absent."""
    path = Path(__file__).resolve().parents[2] / "shared"
    if not path.is_dir():
        pytest.skip(f"development data folder {path.name}/ is not beside the checkout")
    return path


@pytest.fixture(scope="session", autouse=True)
def _short_training() -> Iterator[None]:
    """Within the dozen steps of a training in a test, colours reach their full degree and curves get their points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("avatar.train.loss.SH_INTERVAL", 3)
        patch.setattr("avatar.train.log.LOG_EVERY", 2)
        patch.setattr("avatar.gaussianheadavatar.initial_surface.STEPS", 10)
        patch.setattr("avatar.gaussianheadavatar.model.FIT_STEPS", 20)
        patch.setattr("avatar.gaussianheadavatar.initial_gaussians.CELLS", 24)
        patch.setattr("avatar.gaussianheadavatar.initial_motion.STEPS", 10)
        patch.setattr("avatar.gaussianheadavatar.initial_motion.HEADS", 20)
        yield


@pytest.fixture(scope="session", autouse=True)
def _coarse_textures() -> Iterator[None]:
    """The demo's people are painted in half the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("avatar.demo.render.TEXTURE_SIZE", 384)
        yield


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Prepared subjects and weights of the person who runs the tests stay out of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AVATAR_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.delenv("AVATAR_HEAD", raising=False)
        yield


@pytest.fixture(scope="session")
def tracked_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small tracked folder, image offset 1; do not write into it."""
    return write_tracked_folder(tmp_path_factory.mktemp("tracked") / "someone", frames=30, size=48)


@pytest.fixture(scope="session")
def open_mouth_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, with a head model whose lips are two; do not write into it."""
    return write_tracked_folder(tmp_path_factory.mktemp("mouth") / "someone", frames=30, size=48, mouth_opening=True)
