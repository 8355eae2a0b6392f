"""MediaPipe's face landmarker beside a page: how it is written, and in a page where its files are there."""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import json
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest
from browsers import WEB, camera_flags, chromium
from command_line import avatar
from lively import lively_avatar, lively_run
from pages import says, until
from videos import encode

from avatar.demo.raw_video import filmed
from avatar.export import mediapipe_pack
from avatar.export.mediapipe_pack import PACK, encode_pack, make_pack
from avatar.export.web_page import write_page
from avatar.files.third_party import FACE_LANDMARKER, FOLDER_VARIABLE, TASKS_VISION, find, sha256_of

FPS = 10
NOTE = """() => {
  const drive = avatar.drive;
  window.seen = [];
  avatar.drive = (...face) => (seen.push(face), drive.apply(avatar, face));
}"""


def test_the_command_writes_the_landmarker_beside(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = lively_run(tracked_folder, tmp_path / "run", "model.uv_size=12")
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    said = avatar("export", run, "--webcam", "--out", tmp_path / "x.html", status=1)
    assert f"{TASKS_VISION.name} (pages that a camera drives" in said and "avatar models --download" in said
    assert not (tmp_path / "x.html").exists()
    refused = avatar("export", run, "--webcam", "--out", tmp_path / "x.ply", status=1)
    assert "--webcam belongs to --format web or web-avatar" in refused


@pytest.fixture
def published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package and a model of that name, with their hashes taken for the published ones."""
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / FACE_LANDMARKER.name).write_bytes(b"model")
    with tarfile.open(folder / TASKS_VISION.name, "w:gz") as archive:
        for name in (*mediapipe_pack.MEMBERS, "wasm/vision_wasm_nosimd_internal.wasm"):
            member = tarfile.TarInfo(f"package/{name}")
            member.size = len(name)
            archive.addfile(member, io.BytesIO(name.encode()))
    for known in ("TASKS_VISION", "FACE_LANDMARKER"):
        file = getattr(mediapipe_pack, known)
        monkeypatch.setattr(mediapipe_pack, known, file._replace(sha256=sha256_of(folder / file.name)))
    monkeypatch.setenv(FOLDER_VARIABLE, str(folder))
    return folder


@pytest.mark.parametrize("suffix", [".html", ".avatar"])
def test_the_command_takes_the_publishers_files(
    suffix: str, published: Path, tracked_folder: Path, tmp_path: Path
) -> None:
    run, out = lively_run(tracked_folder, tmp_path / "run", "model.uv_size=12"), tmp_path / f"x{suffix}"
    said = avatar("export", run, "--webcam", "--out", out)
    data = (tmp_path / PACK).read_bytes()
    assert hashlib.sha256(data).hexdigest() in said and mediapipe_pack.NOTICE in said and out.is_file()
    files = json.loads(data[data.rindex(b"avatarLandmarker(") + 17 : -3])["files"]
    found = {name: gzip.decompress(base64.b64decode(text)) for name, text in files.items()}
    assert found == {
        "vision_bundle.mjs": b"vision_bundle.mjs",
        "vision_wasm_internal.js": b"wasm/vision_wasm_internal.js",
        "vision_wasm_internal.wasm": b"wasm/vision_wasm_internal.wasm",
        "face_landmarker.task": b"model",
    }
    (published / TASKS_VISION.name).write_bytes(b"another")
    (tmp_path / PACK).unlink()
    assert "is not the published file or is damaged" in avatar("export", run, "--webcam", "--out", out, status=1)
    assert not (tmp_path / PACK).exists()


def test_the_pack_is_a_licence_and_a_call() -> None:
    text = encode_pack({"a.js": b"hello"}, "1").decode()
    notice, call = text.split("*/\n")
    assert "MediaPipe" in notice and "Apache License" in notice and "TERMS AND CONDITIONS" in notice
    content = json.loads(call.removeprefix("avatarLandmarker(").removesuffix(");\n"))
    assert content["version"] == "1" and list(content["files"]) == ["a.js"]
    assert encode_pack({"a.js": b"hello"}, "1").decode() == text, "the same bytes again"


def test_the_page_and_the_program_mean_the_same_landmarker() -> None:
    module = (WEB / "landmarker.js").read_text()
    assert f'"face_landmarker.task": "{FACE_LANDMARKER.sha256}"' in module and f'PACK = "{PACK}"' in module
    version = re.search(r'VERSION = "([\d.]+)"', module)
    assert version is not None and version[1] in TASKS_VISION.url and version[1] in TASKS_VISION.name


@pytest.fixture
def real_pack(monkeypatch: pytest.MonkeyPatch) -> bytes:
    shared = Path(__file__).resolve().parents[3] / "shared" / "assets"
    if find(FACE_LANDMARKER) is None and shared.is_dir():
        monkeypatch.setenv(FOLDER_VARIABLE, str(shared))
    missing = [file.name for file in (TASKS_VISION, FACE_LANDMARKER) if find(file) is None]
    if missing:
        pytest.skip(f"{' and '.join(missing)} missing: avatar models --download")
    return make_pack()


@pytest.fixture
def real_page(real_pack: bytes, tracked_folder: Path, tmp_path: Path) -> Path:
    (tmp_path / PACK).write_bytes(real_pack)
    trained = lively_avatar(tracked_folder, tmp_path / "run")
    return write_page(trained, tmp_path / "someone.html", "float", webcam=True).path


@pytest.mark.chromium
@pytest.mark.slow
def test_mediapipes_own_landmarker(real_page: Path, tmp_path: Path) -> None:
    pictures = [np.asarray(picture) for picture in filmed(30, 192, 1)]
    encode(tmp_path / "film.mjpeg", pictures, fps=FPS, options=("-c:v", "mjpeg", "-q:v", "3", "-pix_fmt", "yuvj420p"))
    with chromium(*camera_flags(tmp_path / "film.mjpeg")) as browser:
        page = browser.new_context(offline=True).new_page()
        page.goto(f"{real_page.as_uri()}?width=64")
        page.locator("#message").wait_for(state="hidden", timeout=20000)
        page.evaluate(NOTE)
        page.locator("#camera").click()
        says(page, "The avatar follows you.", 120)
        until(page, "seen.length > 20", 60)
        seen = page.evaluate("seen.map(([scores, matrix]) => [scores.jawOpen, Object.keys(scores).length, matrix[14]])")
    opened = np.array([each[0] for each in seen])
    assert opened.max() - opened.min() > 0.1, "the person speaks"
    assert all(count == 52 and -200 < depth < -10 for _, count, depth in seen)
