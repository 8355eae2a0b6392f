"""Files of others: found where they are said to be looked for, taken only with the published hash, fetched whole."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from avatar.cli import main
from avatar.commands import models as command
from avatar.errors import UserError
from avatar.files.third_party import (
    LPIPS_FILES,
    TRACKING_FILES,
    ThirdPartyFile,
    download,
    find,
    models_folder,
    require,
    search_folders,
)

CONTENT = b"a network" * 1000
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def published(tmp_path: Path) -> Iterator[ThirdPartyFile]:
    """A file on a server of this machine."""
    folder = tmp_path / "publisher"
    folder.mkdir()
    (folder / "net.bin").write_bytes(CONTENT)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield ThirdPartyFile("net.bin", f"http://127.0.0.1:{server.server_port}/net.bin", SHA256, 0.01, "MIT", "tests")
    server.shutdown()
    server.server_close()


@pytest.fixture(autouse=True)
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("AVATAR_MODELS", str(tmp_path / "mine"))
    monkeypatch.delenv("AVATAR_LPIPS", raising=False)


def test_places_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, published: ThirdPartyFile) -> None:
    mine, inside = tmp_path / "mine", tmp_path / "mine" / "inside"
    assert find(published) is None
    for folder in (models_folder(), inside, mine):  # from the last to the first
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "net.bin").write_bytes(CONTENT)
        assert find(published) == folder / "net.bin"
    assert search_folders() == [mine, inside, tmp_path / "cache" / "models"]
    monkeypatch.delenv("AVATAR_MODELS")
    assert search_folders() == [tmp_path / "cache" / "models"]
    monkeypatch.delenv("AVATAR_CACHE")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert models_folder() == tmp_path / "home" / ".cache" / "avatar" / "models"


def test_a_missing_file_is_described(published: ThirdPartyFile) -> None:
    with pytest.raises(UserError) as caught:
        require(published)
    for part in ("net.bin", "MIT", "avatar models --download", published.url, str(models_folder()), "$AVATAR_MODELS"):
        assert part in str(caught.value)


def test_another_file_of_that_name_is_refused(published: ThirdPartyFile) -> None:
    models_folder().mkdir(parents=True)
    (models_folder() / "net.bin").write_bytes(CONTENT[:-1])
    with pytest.raises(UserError, match="net.bin is not the published file or is damaged: its SHA-256 is"):
        require(published)


def test_downloading(published: ThirdPartyFile) -> None:
    assert download(published) == models_folder() / "net.bin" == require(published)
    assert [path.name for path in models_folder().iterdir()] == ["net.bin"]


@pytest.mark.parametrize("fault", ["another file", "gone", "no server"])
def test_a_failed_download_leaves_nothing(published: ThirdPartyFile, fault: str) -> None:
    if fault == "another file":
        published = published._replace(sha256="0" * 64)
    elif fault == "gone":
        published = published._replace(url=published.url + "x")
    else:
        published = published._replace(url="http://127.0.0.1:9/net.bin")
    reason = "is not the published file" if fault == "another file" else "cannot download .* fetch it by other means to"
    with pytest.raises(UserError, match=reason):
        download(published)
    assert list(models_folder().iterdir()) == []


def test_the_list_is_whole() -> None:
    for file in (*TRACKING_FILES, *(file for both in LPIPS_FILES.values() for file in both)):
        assert file.url.startswith("https://") and file.licence and file.purpose and file.megabytes > 0
        assert len(file.sha256) == 64 or (len(file.sha256) == 8 and file.sha256 in file.name)
        assert set(file.sha256) <= set("0123456789abcdef")


def test_the_command(
    published: ThirdPartyFile, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    optional = published._replace(name="other.bin", is_optional=True)
    monkeypatch.setattr(command, "TRACKING_FILES", (published, optional))
    monkeypatch.setattr(command, "NETS", ())
    monkeypatch.setattr(command, "FETCHED_LPIPS", ())
    assert main(["models"]) == 1
    said = capsys.readouterr().out
    assert f"missing: put {published.url} into {models_folder()}" in said and f"SHA-256 {SHA256}" in said
    assert main(["models", "--download"]) == 0
    said = capsys.readouterr().out
    assert f"fetching net.bin (0.01 MB, MIT) from {published.url}" in said
    assert f"{models_folder() / 'net.bin'}, SHA-256 as published" in said
    (models_folder() / "net.bin").write_bytes(b"something else")
    assert main(["models"]) == 1 and "is damaged" in capsys.readouterr().out
    (models_folder() / "net.bin").write_bytes(CONTENT)
    (models_folder() / "other.bin").unlink()
    assert main(["models"]) == 0  # an optional file may be missing
