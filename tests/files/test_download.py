"""Whatever a server answers, a download is the published file or one sentence, in bounded memory, place and time."""

from __future__ import annotations

import hashlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from avatar.cli import main
from avatar.commands import models as command
from avatar.errors import UserError
from avatar.files import download as downloads
from avatar.files.third_party import ThirdPartyFile, download, find, models_folder, require
from avatar.losses.lpips import load_lpips, lpips_folder, save_lpips
from avatar.losses.lpips_network import Lpips

CONTENT = b"a network" * 1000
SHA256 = hashlib.sha256(CONTENT).hexdigest()
WHOLE = f"HTTP/1.1 200 OK\r\nContent-Length: {len(CONTENT)}\r\n\r\n".encode() + CONTENT
MANY = 3 * 2**20  # bytes: more than the bound of a file of 0.01 MB
Answer = bytes | Callable[[socket.socket], None]


@contextmanager
def server(answer: Answer) -> Iterator[ThirdPartyFile]:
    """A file on a server of this machine that answers every request so."""

    def serve() -> None:
        with suppress(OSError):
            while True:
                connection, _ = listener.accept()
                with connection, suppress(OSError):
                    connection.recv(2**16)
                    connection.sendall(answer) if isinstance(answer, bytes) else answer(connection)
                    connection.shutdown(socket.SHUT_WR)
                    connection.settimeout(2.0)
                    connection.recv(1)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, daemon=True).start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}/net.bin"
        yield ThirdPartyFile("net.bin", url, SHA256, 0.01, "MIT", "tests")
        listener.shutdown(socket.SHUT_RDWR)


def drop(connection: socket.socket) -> None:
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    connection.close()


def endless(connection: socket.socket) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
    for _ in range(MANY // 2**16 + 1000):
        connection.sendall(bytes(2**16))


def trickle(connection: socket.socket) -> None:
    connection.sendall(WHOLE[:-100])
    for _ in range(200):
        connection.sendall(b"x")
        time.sleep(0.05)


def silent(connection: socket.socket) -> None:
    time.sleep(1.0)


BAD_ANSWERS: dict[str, tuple[Answer, str]] = {
    "nothing": (b"", "cannot download"),
    "a broken connection": (drop, "cannot download"),
    "another protocol": (b"SSH-2.0-OpenSSH_9.6\r\n\r\n", "cannot download"),
    "letters that steer a terminal": (b"\x1b[2J\x1b]0;x\x07\r\n\r\n", "cannot download"),
    "a status that is none": (b"HTTP/1.1 abc OK\r\n\r\n", "cannot download"),
    "an error": (b"HTTP/1.1 500 No\r\nContent-Length: 0\r\n\r\n", "cannot download"),
    "a redirect to nowhere": (b"HTTP/1.1 302 Found\r\nLocation: http://[::1\r\n\r\n", "cannot download"),
    "a redirect to a file": (b"HTTP/1.1 302 Found\r\nLocation: file:///etc/passwd\r\n\r\n", "cannot download"),
    "a redirect in circles": (b"HTTP/1.1 302 Found\r\nLocation: /net.bin\r\nContent-Length: 0\r\n\r\n", "cannot download"),
    "a redirect without a place": (b"HTTP/1.1 302 Found\r\nContent-Length: 0\r\n\r\n", "cannot download"),
    "a length that is no number": (b"HTTP/1.1 200 OK\r\nContent-Length: many\r\n\r\nshort", "is not the published file"),
    "a negative length": (b"HTTP/1.1 200 OK\r\nContent-Length: -5\r\n\r\nshort", "is not the published file"),
    "a huge length": (b"HTTP/1.1 200 OK\r\nContent-Length: 99999999999999\r\n\r\n", r"at most 1\.1 MB"),
    "less than it says": (WHOLE[:-100], "it ends after 8900 of 9000 bytes"),
    "broken chunks": (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzzz\r\nabc\r\n", "cannot download"),
    "chunks cut short": (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nff\r\nabc", "cannot download"),
    "headers without end": (b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * 1000 + b"\r\n", "cannot download"),
    "a header of a megabyte": (b"HTTP/1.1 200 OK\r\na: " + b"b" * 2**20 + b"\r\n\r\n", "cannot download"),
    "more than the file has": (endless, r"more than 1\.1 MB"),
    "another file": (b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nshort", "is not the published file"),
    "nothing for too long": (silent, "timed out"),
    "a byte now and then": (trickle, "too slow"),
}  # fmt: skip


@pytest.fixture(autouse=True)
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("AVATAR_MODELS", str(tmp_path / "mine"))
    for name in ("AVATAR_LPIPS", "http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", BAD_ANSWERS)
def test_a_bad_answer_gets_one_sentence_and_leaves_nothing(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answer, sentence = BAD_ANSWERS[name]
    if answer in (silent, trickle):
        monkeypatch.setattr(downloads, "PATIENCE", 0.5)
    if answer is trickle:
        monkeypatch.setattr(downloads, "SLOWEST", 20_000)
    with server(answer) as file, pytest.raises(UserError, match=sentence) as refusal:
        download(file)
    said = str(refusal.value)
    assert said.isprintable() and file.url in said and len(said) < 600
    assert list(models_folder().iterdir()) == []


def test_a_good_answer_in_chunks_is_the_file() -> None:
    chunks = b"".join(b"%x\r\n%s\r\n" % (len(part), part) for part in (CONTENT[:100], CONTENT[100:])) + b"0\r\n\r\n"
    with server(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + chunks) as file:
        assert download(file).read_bytes() == CONTENT


def test_a_damaged_file_is_replaced_by_the_download(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Wherever it lies: in the cache it is written over, elsewhere it is passed over."""
    for folder in (models_folder(), tmp_path / "mine"):
        folder.mkdir(parents=True)
        (folder / "net.bin").write_bytes(CONTENT[:-1] + b"?")
    with server(WHOLE) as file:
        monkeypatch.setattr(command, "TRACKING_FILES", (file,))
        monkeypatch.setattr(command, "PAGE_FILES", ())
        monkeypatch.setattr(command, "NETS", ())
        monkeypatch.setattr(command, "FETCHED_LPIPS", ())
        assert main(["models"]) == 1
        assert main(["models", "--download"]) == 0
        said = capsys.readouterr().out
        assert "net.bin is not the published file or is damaged" in said and "SHA-256 as published" in said
        assert require(file) == find(file) == models_folder() / "net.bin"
        assert (tmp_path / "mine" / "net.bin").read_bytes() != CONTENT
        assert main(["models", "--download"]) == 0 and "fetching" not in capsys.readouterr().out


def test_damaged_weights_are_replaced_by_the_download(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    good = Lpips("squeeze")
    lpips_folder().mkdir(parents=True)
    weights = lpips_folder() / "lpips_squeeze.safetensors"
    weights.write_bytes(b"half of it")
    monkeypatch.setattr(command, "TRACKING_FILES", ())
    monkeypatch.setattr(command, "PAGE_FILES", ())
    monkeypatch.setattr(command, "NETS", ("squeeze",))
    monkeypatch.setattr(command, "download_lpips", lambda net, folder: save_lpips(good, folder / weights.name))
    assert main(["models"]) == 1 and main(["models", "--download"]) == 0
    assert load_lpips("squeeze").fingerprint() == good.fingerprint()
    assert "lpips_squeeze.safetensors is damaged" in capsys.readouterr().out


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file")
    with server(WHOLE) as file, pytest.raises(UserError, match=r"net\.bin cannot be written"):
        download(file)
    (tmp_path / "cache").unlink()
    (models_folder() / "net.bin" / "a folder").mkdir(parents=True)
    with server(WHOLE) as file, pytest.raises(UserError, match=r"net\.bin cannot be written"):
        download(file)
