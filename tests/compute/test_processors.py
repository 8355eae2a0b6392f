"""No more threads than a container allows."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from avatar.compute import processors
from avatar.compute.processors import container_limit, limit_threads, processor_count


@pytest.fixture
def cgroup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "cpu").mkdir()
    monkeypatch.setattr(processors, "_CGROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "")  # so that it is put back
    monkeypatch.delenv("OMP_NUM_THREADS")
    return tmp_path


def test_a_containers_limit_counts_in_either_version(cgroup: Path) -> None:
    assert container_limit() is None and processor_count() == 16
    (cgroup / "cpu" / "cpu.cfs_quota_us").write_text("-1\n")
    (cgroup / "cpu" / "cpu.cfs_period_us").write_text("100000\n")
    (cgroup / "cpu.max").write_text("max 100000\n")
    assert container_limit() is None and processor_count() == 16
    (cgroup / "cpu" / "cpu.cfs_quota_us").write_text("400000\n")
    assert processor_count() == 4
    (cgroup / "cpu.max").write_text("250000 100000\n")
    assert processor_count() == 3  # two and a half
    (cgroup / "cpu.max").write_text("10000 100000\n")
    assert processor_count() == 1
    (cgroup / "cpu.max").write_text("6400000 100000\n")
    assert processor_count() == 16


def test_threads_are_limited_unless_their_number_is_given(cgroup: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit_threads()
    assert "OMP_NUM_THREADS" not in os.environ
    (cgroup / "cpu.max").write_text("200000 100000\n")
    limit_threads()
    assert os.environ["OMP_NUM_THREADS"] == "2"
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    limit_threads()
    assert os.environ["OMP_NUM_THREADS"] == "5"
