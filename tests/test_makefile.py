"""What the Makefile's targets would run, and what an image is made of."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def commands(target: str, environment: Path) -> str:
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    words = ["make", "--dry-run", target, f"VENV={environment}"]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("target", ["setup", "demo"])
def test_a_demo_installs_no_developers_tools(target: str, tmp_path: Path) -> None:
    said = commands(target, tmp_path / "new")
    assert "-e '.[track,view]'" in said and "dev]" not in said


@pytest.mark.parametrize(
    "target", ["test", "test-all", "check", "stress", "fuzz", "smoke", "paper-smoke", "gpu-check", "wheel"]
)
def test_developers_targets_install_their_tools_once(target: str, tmp_path: Path) -> None:
    assert commands(target, tmp_path / "new").count("-e '.[dev]'") == 1
    (tmp_path / "used").mkdir()
    for name in (".tools", ".installed", ".installed-dev"):
        (tmp_path / "used" / name).touch()
    assert "-e '.[" not in commands(target, tmp_path / "used") and "-e '.[" not in commands("demo", tmp_path / "used")


def test_missing_headers_of_python_are_said_before_anything_is_installed(tmp_path: Path) -> None:
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    (tmp_path / "sysconfig.py").write_text("def get_path(name): return '/nowhere'\n")
    words = ["make", "setup", f"VENV={tmp_path / 'new'}", f"PYTHON=PYTHONPATH={tmp_path} {sys.executable}"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode != 0 and "headers" in done.stdout and "python3-dev" in done.stdout
    assert not (tmp_path / "new").exists()


def test_slow_tests_are_left_to_test_all(tmp_path: Path) -> None:
    assert "not slow and not chromium" in commands("test", tmp_path) and "not slow" not in commands(
        "test-all", tmp_path
    )
    assert "make test-all" in (ROOT / ".ci" / "run").read_text()


def test_an_image_is_made_of_what_a_wheel_takes() -> None:
    """.dockerignore leaves out all but what CMakeLists.txt and pyproject.toml read."""
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = project["tool"]["scikit-build"]["wheel"]["packages"]
    files = ["CMakeLists.txt", "pyproject.toml", "constraints.txt", "LICENSE", project["project"]["readme"]]
    assert allowed == {"configs", *packages, *files} and all((ROOT / name).exists() for name in allowed)
    image = (ROOT / "Dockerfile").read_text()
    assert "[track,view]" in image and {"track", "view"} <= set(project["project"]["optional-dependencies"])
    assert "USER 1000" in image and image.rstrip().endswith('ENTRYPOINT ["avatar"]')
