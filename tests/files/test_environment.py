"""Users without a home folder, `~` in variables, and the cache that belongs to somebody else."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from avatar.errors import UserError
from avatar.files.environment import cache_folder, named_path
from avatar.files.third_party import models_folder, search_folders
from avatar.losses.lpips import lpips_folder


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("AVATAR_CACHE", "AVATAR_LPIPS", "AVATAR_MODELS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / "home"


@pytest.fixture
def nobody(home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user without HOME and without an entry in the list of users; where their cache goes."""

    def unknown() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", unknown)
    return home.parent / f"avatar-{os.getuid()}"


def test_everything_is_kept_below_one_folder(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cache_folder() == home / ".cache" / "avatar"
    monkeypatch.setenv("AVATAR_CACHE", "~/kept")
    assert cache_folder() == home / "kept"
    assert (models_folder(), lpips_folder()) == (home / "kept" / "models", home / "kept" / "lpips")
    assert search_folders() == [home / "kept" / "models"]
    monkeypatch.setenv("AVATAR_CACHE", "")
    assert cache_folder() == home / ".cache" / "avatar"


@pytest.mark.parametrize("variable", ["AVATAR_CACHE", "AVATAR_LPIPS", "AVATAR_MODELS", "AVATAR_HEAD"])
@pytest.mark.usefixtures("home")
def test_the_home_of_an_unknown_user_is_a_sentence(variable: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(variable, "~nobody-of-this-name/x")
    with pytest.raises(UserError, match=rf"^{variable}=~nobody-of-this-name/x .*give the whole path"):
        named_path(variable)


def test_a_user_without_a_home_keeps_things_among_the_temporary_files(
    nobody: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cache_folder() == nobody and lpips_folder() == nobody / "lpips"
    nobody.mkdir()
    assert cache_folder() == nobody
    monkeypatch.setenv("AVATAR_CACHE", "/kept")
    assert cache_folder() == Path("/kept")


def test_the_temporary_folder_of_somebody_else_is_not_used(nobody: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nobody.symlink_to(nobody.parent)
    with pytest.raises(UserError, match=r"belongs to another user: set AVATAR_CACHE"):
        cache_folder()
    nobody.unlink()
    monkeypatch.setattr("os.getuid", lambda: 12345)
    (nobody.parent / "avatar-12345").mkdir()
    with pytest.raises(UserError, match=r"avatar-12345 belongs to another user: set AVATAR_CACHE"):
        cache_folder()
