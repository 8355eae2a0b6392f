"""The script for the first session on a GPU runs, its checks hold, and they can fail."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest

from avatar.train import step_runner

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture
def measure_gpu(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(SCRIPTS)
    for name in ("measure_gpu", "count_launches"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import measure_gpu  # type: ignore[import-not-found]

    return measure_gpu


SMALL = ["--size", "32", "--splats", "30", "--uv-size", "6", "--repeats", "1", "--quick"]


def test_checks_times_and_tunings_are_written(
    measure_gpu: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measure_gpu, "STREAMED", 2)
    for module in (measure_gpu, step_runner):
        monkeypatch.setattr(module, "WARM", 1)
    assert measure_gpu.main([*SMALL, "--out", str(tmp_path)]) == 0
    text = (tmp_path / "gpu.md").read_text()
    assert "parity with the CPU: image off by " in text and "the same bits" in text and "FAILED" not in text
    assert "replaying: 2 replayed training steps, the bits of launched ones" in text
    for what in ("splatting, backward", "a rendered frame", "a training step with D-SSIM", "the same two, replayed"):
        assert f"| {what} | " in text
    assert "| 8 | 8 | 4 | 2 | 1 | " in text or "| 16 | 32 | 32 | 2 | 1 | " in text


def test_a_check_that_fails_is_the_exit_status(
    measure_gpu: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measure_gpu, "IMAGE_TOLERANCE", -1.0)
    for name in ("check_repeats", "check_no_waiting", "check_replays"):
        monkeypatch.setattr(measure_gpu, name, lambda *_: "not tried")
    monkeypatch.setattr(measure_gpu, "time_all", lambda *_: {})
    monkeypatch.setattr(measure_gpu, "tune", lambda *_: [])
    assert measure_gpu.main([*SMALL, "--out", str(tmp_path)]) == 1
    assert "parity with the CPU: FAILED, image off by" in (tmp_path / "gpu.md").read_text()
