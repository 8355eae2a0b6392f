"""`avatar doctor`: a table of name, state and what to do, at once."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from command_line import avatar

from avatar.commands import doctor
from avatar.errors import UserError
from avatar.files.third_party import FACE_LANDMARKER, TRACKING_FILES, lpips_folder, models_folder, sha256_of

NAMES = [
    *("PyTorch", "compiled core", "configuration", "video encoder", "GPU", "head model"),
    "models",
    *doctor.EXTRAS,
]


@pytest.fixture(autouse=True)
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One without a GPU and without files of others."""
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    for name in ("AVATAR_MODELS", "AVATAR_LPIPS", "AVATAR_HEAD"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(doctor, "has_gpu_driver", lambda: False)


def rows(output: str) -> dict[str, tuple[str, str]]:
    """State and advice by name, read by the columns of the heading."""
    lines = output.splitlines()
    begin = next(i for i, line in enumerate(lines) if line.startswith("name"))
    state, advice = lines[begin].index("state"), lines[begin].index("what to do")
    return {line[:state].strip(): (line[state:advice].strip(), line[advice:].strip()) for line in lines[begin + 1 :]}


def test_it_is_a_table_with_whole_names() -> None:
    output = avatar("doctor")
    found = rows(output)
    assert list(found) == NAMES
    assert found["compiled core"] == ("works", "") and found["configuration"] == ("found", "")
    assert found["video encoder"][0].startswith("ffmpeg ")
    assert "AVATAR_HEAD" in found["head model"][1] and found["GPU"][0] == "none"
    assert max(map(len, output.splitlines())) <= 120


def test_it_does_not_wait_for_pytorch() -> None:
    program = (
        "import sys; from avatar.cli import main; main(['doctor']); assert 'torch' not in sys.modules; print('light')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "light" in done.stdout, done.stderr


def test_models_are_counted_where_they_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    assert rows(avatar("doctor"))["models"] == ("0 of 3 there", "avatar models lists them and the optional ones")
    models_folder().mkdir(parents=True)
    for file in TRACKING_FILES:
        (models_folder() / file.name).write_bytes(b"another file")
    assert rows(avatar("doctor"))["models"][0] == "0 of 3 there"
    own = FACE_LANDMARKER._replace(sha256=sha256_of(models_folder() / FACE_LANDMARKER.name))
    monkeypatch.setattr(doctor, "TRACKING_FILES", (own, *TRACKING_FILES[1:]))
    lpips_folder().mkdir()
    (lpips_folder() / "lpips_squeeze.safetensors").touch()
    assert rows(avatar("doctor"))["models"][0] == "2 of 3 there"


def test_the_head_model_is_sought_where_the_variable_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_HEAD", str(tmp_path / "none"))
    state, advice = rows(avatar("doctor"))["head model"]
    assert state == "missing" and str(tmp_path / "none") in advice
    (tmp_path / "none" / "FLAME2023").mkdir(parents=True)
    (tmp_path / "none" / "FLAME2023" / "generic_model.pkl").touch()
    assert rows(avatar("doctor"))["head model"][0] == "found"


def test_a_package_that_is_missing_has_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name in doctor.EXTRAS:
            raise PackageNotFoundError(name)
        return "1"

    monkeypatch.setattr(doctor, "version", version)
    found = rows(avatar("doctor"))
    assert found["viser"] == ("missing", "avatar view: pip install '.[view]' in the program's checkout")
    assert "'.[plots]'" in found["matplotlib"][1] and "'.[track]'" in found["mediapipe"][1]


@pytest.mark.parametrize("part", ["draw_one_triangle", "config_dir"])
def test_what_every_command_needs_decides_the_status(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> str:
        raise UserError("it is not there")

    monkeypatch.setattr(doctor, part, fail)
    assert "broken" in avatar("doctor", status=1)


def test_a_gpu_is_tested_where_there_is_a_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "has_gpu_driver", lambda: True)
    monkeypatch.setattr(doctor, "find_gpu", lambda: "cuda:0 computes what the CPU does")
    assert rows(avatar("doctor"))["GPU"] == ("cuda:0 computes what the CPU does", "")

    def fail() -> str:
        raise UserError("its driver is too old")

    monkeypatch.setattr(doctor, "find_gpu", fail)
    assert rows(avatar("doctor"))["GPU"] == ("not used", "its driver is too old")
