"""Whatever lies under a file's name, a reader answers at once and in bounded memory."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from special_files import SPECIAL

from avatar.data.read_image import read_image, read_mask
from avatar.errors import UserError
from avatar.evaluation.compare import read_evaluation
from avatar.evaluation.verify import verify
from avatar.files.read import MissingFile, read_bytes, read_json, read_text, shown_size
from avatar.files.third_party import sha256_of
from avatar.head.assets import find_model_file, find_uv_obj, load_head_assets
from avatar.losses.lpips import load_lpips
from avatar.pipeline.refine_plan import Plan
from avatar.sweep.state import read_job, read_sweep
from data_prep.formats.metrical_tracker import read_tracking
from data_prep.track.footage.video import open_video

ROOT = Path(__file__).resolve().parents[2]
READING = re.compile(
    r"\.read_text\(|(?<!opening)\.read_bytes\(|\.open\((\)|\"rb?\"|encoding)|\b(safe_open|load_file|imread|fromfile)\("
    r"|\b(np|torch|json)\.load(txt)?\("
)
# What they open is the program's own, the system's, just written by them, or checked before.
OPEN_BY_THEMSELVES = {
    "avatar/bench/machine.py",
    "avatar/bench/peak_memory.py",
    "avatar/compute/memory.py",
    "avatar/compute/processors.py",
    "avatar/data/tensor_file.py",
    "avatar/evaluation/verify.py",
    "avatar/export/mediapipe_pack.py",
    "avatar/export/web_page.py",
    "avatar/files/video.py",
    "avatar/html/document.py",
    "avatar/losses/lpips.py",
    "avatar/view/viewer.py",
    "avatar/view/viser_server.py",
}
# Readers beside those of tests/fuzz, by the file that they read.
READERS: dict[str, Callable[[Path], object]] = {
    "00001.jpg": read_image,
    "00001.png": read_mask,
    "eval/results.json": lambda path: read_evaluation("run", path.parents[1]),
    "verified/results.json": verify,
    "rounds/plan.json": lambda path: Plan.load(path.parents[1]),
    "sweep.json": lambda path: read_sweep(path.parent),
    "job.json": lambda path: read_job(path.parent),
    "net.tflite": lambda path: sha256_of(path, 1000),
    "head_model.pkl": load_head_assets,
    "clip.mp4": open_video,
}


@pytest.mark.timeout(20, func_only=True)
@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file_is_refused_at_once(name: str, kind: str, tmp_path: Path) -> None:
    if name == "clip.mp4" and "sparse" in kind:
        pytest.skip("videos are of any size")
    make, word = SPECIAL[kind]
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    make(path)
    with pytest.raises(UserError) as refusal:
        READERS[name](path)
    assert word in str(refusal.value) and str(path) in str(refusal.value)


@pytest.mark.timeout(20, func_only=True)
@pytest.mark.parametrize("kind", SPECIAL)
def test_a_frame_that_is_no_file_is_left_out_with_the_reason(kind: str, tmp_path: Path) -> None:
    make, word = SPECIAL[kind]
    make(tmp_path / "00001.frame")
    assert word in read_tracking({1: tmp_path / "00001.frame"}).bad[1]


@pytest.mark.timeout(20, func_only=True)
@pytest.mark.parametrize("kind", SPECIAL)
def test_weights_that_are_no_file_are_not_read(kind: str, tmp_path: Path) -> None:
    SPECIAL[kind][0](tmp_path / "lpips_squeeze.safetensors")
    with pytest.raises(UserError):
        load_lpips("squeeze", tmp_path)


@pytest.mark.parametrize("name", ["head_template.obj", "generic_model.pkl"])
def test_a_fifo_beside_the_head_model_is_not_passed_over(name: str, tmp_path: Path) -> None:
    """It is found, so that reading it can say what it is."""
    os.mkfifo(tmp_path / name)
    (tmp_path / "other.obj").touch()
    (tmp_path / "other.pkl").touch()
    assert tmp_path / name in (find_uv_obj(tmp_path), find_model_file(tmp_path))


def test_folders_and_missing_files(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nothing")
    (tmp_path / "loop").symlink_to("loop")
    for path in (tmp_path / "none", tmp_path / "link", "/dev/null/x"):
        with pytest.raises(UserError, match="does not exist|Not a directory"):
            read_bytes(path, 10)
    with pytest.raises(MissingFile):
        read_bytes(tmp_path / "none", 10)
    for path, word in (
        (tmp_path, "is a folder, not a file"),
        (tmp_path / "loop", "cannot be read"),
        (tmp_path / ("x" * 300), "cannot be read"),
        (Path("zero\0byte"), "cannot be read"),
        (Path("half\ud83d"), "cannot be read|does not exist"),
    ):
        with pytest.raises(UserError, match=word):
            read_bytes(path, 10)


def test_sizes(tmp_path: Path) -> None:
    path = tmp_path / "ten"
    path.write_bytes(b"0123456789")
    assert read_bytes(path, 10) == b"0123456789"
    with pytest.raises(UserError, match="10 bytes; files of its kind are read up to 9 bytes"):
        read_bytes(path, 9)
    assert [shown_size(n) for n in (999, 1500, 2_000_000, 20 * 10**9)] == ["999 bytes", "1.5 KB", "2.0 MB", "20.0 GB"]


def test_a_file_of_the_system_that_says_it_is_empty_is_read_to_its_bound() -> None:
    path = Path("/proc/self/maps")
    if not path.is_file():
        pytest.skip("there is no /proc")
    assert len(read_bytes(path, 2**22)) > 100
    with pytest.raises(UserError, match="are read up to 100 bytes"):
        read_bytes(path, 100)


def test_text_and_json(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_text(path, 100) == '{"a": 1}' and read_json(path) == {"a": 1}
    path.write_bytes(b"caf\xe9")
    with pytest.raises(UserError, match=r"is not UTF-8 text \(byte 3\)"):
        read_text(path, 100)
    for wrong in (b"{", b"[" * 100_000, b"1" * 5000):
        path.write_bytes(wrong)
        with pytest.raises(UserError, match="cannot be read as JSON"):
            read_json(path)


@pytest.mark.parametrize("package", ["avatar", "data_prep"])
def test_every_reader_opens_its_files_in_one_place(package: str) -> None:
    paths = {str(path.relative_to(ROOT)): path for path in sorted((ROOT / package).rglob("*.py"))}
    found = {name for name, path in paths.items() if READING.search(path.read_text(encoding="utf-8"))}
    assert found - OPEN_BY_THEMSELVES == set()
