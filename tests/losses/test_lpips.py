"""Where LPIPS weights come from, and that damaged or hostile files end in a sentence and run nothing."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import http.server
import pickle
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from avatar.errors import UserError
from avatar.files.third_party import LPIPS_FILES, ThirdPartyFile
from avatar.losses.lpips import (
    MissingWeights,
    download_lpips,
    from_published,
    load_lpips,
    lpips_folder,
    save_lpips,
)
from avatar.losses.lpips_network import Lpips


@pytest.fixture(autouse=True)
def no_own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("AVATAR_LPIPS", raising=False)


def publish(folder: Path, lpips: Lpips) -> tuple[ThirdPartyFile, ThirdPartyFile]:
    """Write `lpips` the way its publishers do: torchvision's file with a classifier too, and the linear heads."""
    folder.mkdir(exist_ok=True)
    state = lpips.state_dict()
    backbone = {name: tensor for name, tensor in state.items() if name.startswith("features.")}
    torch.save({**backbone, "classifier.1.weight": torch.rand(10, 512, 1, 1)}, folder / "backbone.pth")
    torch.save(
        {f"lin{i}.model.1.weight": head.data.reshape(1, -1, 1, 1) for i, head in enumerate(lpips.heads)},
        folder / "heads.pth",
    )
    sums = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in ("backbone.pth", "heads.pth")}
    return (
        ThirdPartyFile("backbone.pth", (folder / "backbone.pth").as_uri(), sums["backbone.pth"][:8], 3),
        ThirdPartyFile("heads.pth", (folder / "heads.pth").as_uri(), sums["heads.pth"], 3),
    )


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


def same(first: Lpips, second: Lpips) -> bool:
    return first.fingerprint() == second.fingerprint()


def test_folder_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert lpips_folder() == tmp_path / "cache" / "lpips"
    monkeypatch.setenv("AVATAR_LPIPS", str(tmp_path / "mine"))
    assert lpips_folder() == tmp_path / "mine"
    monkeypatch.delenv("AVATAR_LPIPS")
    monkeypatch.delenv("AVATAR_CACHE")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert lpips_folder() == tmp_path / "home" / ".cache" / "avatar" / "lpips"


def test_missing_weights_say_which_files_and_where(tmp_path: Path) -> None:
    with pytest.raises(MissingWeights) as caught:
        load_lpips("vgg")
    message = str(caught.value)
    assert str(tmp_path / "cache" / "lpips") in message and "AVATAR_LPIPS" in message
    assert "vgg16-397923af.pth (https://download.pytorch.org/models/vgg16-397923af.pth)" in message
    assert "lin_v0.1_vgg.pth (https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/" in message
    with pytest.raises(UserError, match="LPIPS network must be one of vgg, alex, squeeze, not 'resnet'"):
        load_lpips("resnet")  # type: ignore[arg-type]


def test_file_folder_and_cache(tmp_path: Path) -> None:
    lpips = Lpips("squeeze")
    save_lpips(lpips, tmp_path / "w.safetensors")
    assert same(load_lpips("squeeze", tmp_path / "w.safetensors"), lpips)
    folder = tmp_path / "cache" / "lpips"
    folder.mkdir(parents=True)
    save_lpips(lpips, folder / "lpips_squeeze.safetensors")
    assert same(load_lpips("squeeze"), lpips)
    assert same(load_lpips("squeeze", folder), lpips)
    with pytest.raises(MissingWeights):
        load_lpips("alex")


def test_published_files_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lpips = Lpips("squeeze")
    files = publish(tmp_path / "by_hand", lpips)
    monkeypatch.setitem(LPIPS_FILES, "squeeze", files)
    assert same(load_lpips("squeeze", tmp_path / "by_hand"), lpips)


def test_download_by_http_checks_and_converts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lpips = Lpips("squeeze")
    files = publish(tmp_path / "site", lpips)
    with served(tmp_path / "site") as url:
        remote = tuple(file._replace(url=url + file.name) for file in files)
        monkeypatch.setitem(LPIPS_FILES, "squeeze", remote)
        with pytest.raises(MissingWeights):
            load_lpips("squeeze")
        assert not lpips_folder().exists()
        assert same(load_lpips("squeeze", download=True), lpips)
    assert [path.name for path in lpips_folder().iterdir()] == ["lpips_squeeze.safetensors"]
    assert same(load_lpips("squeeze", download=True), lpips)  # the server is gone: from the cache


@pytest.mark.parametrize("failure", ["absent", "refused", "another file", "cut short"])
def test_failed_download_leaves_nothing(tmp_path: Path, failure: str) -> None:
    files = publish(tmp_path / "site", Lpips("squeeze"))
    site = tmp_path / "site"
    with served(site) as url:
        remote = [file._replace(url=url + file.name) for file in files]
        if failure == "absent":
            (site / "heads.pth").unlink()
            expected = r"cannot download http://.*/heads\.pth \(File not found\); fetch it by other means to"
        elif failure == "refused":
            remote[0] = remote[0]._replace(url="http://127.0.0.1:1/backbone.pth")
            expected = r"cannot download http://127\.0\.0\.1:1/backbone\.pth \(.*[Rr]efused"
        elif failure == "another file":
            (site / "heads.pth").write_bytes(b"<html>sign in</html>")
            expected = r"http://.*/heads\.pth is not the published file or is damaged: its SHA-256 is [0-9a-f]{64}, not"
        else:
            data = (site / "backbone.pth").read_bytes()
            (site / "backbone.pth").write_bytes(data[: len(data) // 2])
            expected = r"http://.*/backbone\.pth is not the published file or is damaged: its SHA-256 is [0-9a-f]{8}, "
        with pytest.raises(UserError, match=expected):
            download_lpips("squeeze", tmp_path / "weights", (remote[0], remote[1]))
    assert list((tmp_path / "weights").iterdir()) == []


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(UserError, match=r"cannot keep LPIPS weights in .*file/lpips"):
        download_lpips("squeeze", tmp_path / "file" / "lpips", publish(tmp_path / "site", Lpips("squeeze")))


class Bomb:
    """A pickle that makes a file when it is loaded by plain pickle."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.marker,))


@pytest.mark.parametrize("container", ["torch.save", "pickle"])
@pytest.mark.parametrize("checksum_matches", [False, True])
def test_code_in_a_pickle_is_never_run(tmp_path: Path, container: str, checksum_matches: bool) -> None:
    marker = tmp_path / "run"
    files = publish(tmp_path / "weights", Lpips("squeeze"))
    path = tmp_path / "weights" / "backbone.pth"
    if container == "torch.save":
        torch.save({"features.0.weight": Bomb(marker)}, path)
        with contextlib.suppress(Exception):
            torch.load(path, weights_only=False)
    else:
        path.write_bytes(pickle.dumps({"features.0.weight": Bomb(marker)}, protocol=2))
        pickle.loads(path.read_bytes())
    assert marker.exists()  # the bomb is live
    marker.unlink()
    expected = "is not the published file or is damaged"
    if checksum_matches:  # as if the attacker had found the eight digits
        files = (files[0]._replace(sha256=hashlib.sha256(path.read_bytes()).hexdigest()[:8]), files[1])
        expected = "is damaged or holds more than plain tensors; nothing in it was run"
    with pytest.raises(UserError, match=expected):
        from_published("squeeze", tmp_path / "weights", files)
    assert not marker.exists()


@pytest.mark.parametrize("content", ["a list", "no tensors", "truncated", "empty"])
def test_torch_files_of_another_kind(tmp_path: Path, content: str) -> None:
    files = publish(tmp_path, Lpips("squeeze"))
    path = tmp_path / "backbone.pth"
    data = path.read_bytes()
    if content == "a list":
        torch.save([torch.zeros(3)], path)
    elif content == "no tensors":
        torch.save({"epoch": 3}, path)
    else:
        path.write_bytes(data[:1000] if content == "truncated" else b"")
    with pytest.raises(UserError, match=r"backbone\.pth (is damaged|does not hold a dictionary of tensors)"):
        from_published("squeeze", tmp_path, (files[0]._replace(sha256=""), files[1]))


@pytest.mark.parametrize("content", ["truncated", "empty", "garbage", "pickle"])
def test_damaged_safetensors(tmp_path: Path, content: str) -> None:
    path = tmp_path / "lpips_squeeze.safetensors"
    marker = tmp_path / "run"
    save_lpips(Lpips("squeeze"), path)
    data = path.read_bytes()
    path.write_bytes(
        {
            "truncated": data[: len(data) - 100],
            "empty": b"",
            "garbage": bytes(range(256)) * 40,
            "pickle": pickle.dumps(Bomb(marker)),
        }[content]
    )
    with pytest.raises(UserError, match=r"lpips_squeeze\.safetensors is damaged or no safetensors file"):
        load_lpips("squeeze", tmp_path)
    assert not marker.exists()


def test_weights_of_another_network_or_with_nan(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    save_lpips(Lpips("squeeze"), path)
    with pytest.raises(
        UserError,
        match=r"w\.safetensors does not hold LPIPS weights for 'alex': \S+ should have shape \[.*\], the file has",
    ):
        load_lpips("alex", path)
    broken = Lpips("squeeze")
    broken.heads[2].data[7] = float("nan")
    save_lpips(broken, path)
    with pytest.raises(UserError, match=r"w\.safetensors cannot be used: heads\.2 has 1 non-finite"):
        load_lpips("squeeze", path)
