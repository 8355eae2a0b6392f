from __future__ import annotations

from pathlib import Path

import pytest

from avatar.compute import memory
from avatar.compute.memory import Need, available_bytes, check_memory, in_words
from avatar.errors import UserError

GIB = 2**30


def test_a_container_allows_no_more_than_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Either version of Linux's interface; "max" is none, and so is a file that is not there."""
    limits = (tmp_path / "memory.max", tmp_path / "memory.limit_in_bytes")
    monkeypatch.setattr(memory, "_CGROUP_LIMITS", limits)
    machine = available_bytes()
    assert machine > 2**27
    limits[0].write_text("max\n")
    assert available_bytes() > 2**27
    limits[1].write_text(f"{2**20}\n")
    assert available_bytes() == 2**20
    limits[0].write_text(f"{2**19}\n")
    assert available_bytes() == 2**19


def test_too_much_is_refused_with_both_figures_and_what_to_lower(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = [Need("the paint", 3 * GIB, "--paint"), Need("the canvas", 12 * GIB, "--size")]
    check_memory("painting", needs, 15 * GIB)
    with pytest.raises(UserError) as caught:
        check_memory("painting", needs, 15 * GIB - 1)
    assert str(caught.value) == (
        "painting needs about 15.0 GiB of memory, and 15.0 GiB are available; the canvas takes 12.0 GiB of it: lower --size"
    )
    monkeypatch.setattr(memory, "available_bytes", lambda: float("inf"))
    check_memory("painting", needs)
    monkeypatch.setattr(memory, "available_bytes", lambda: float(GIB))
    with pytest.raises(UserError, match=r"and 1\.0 GiB are available"):
        check_memory("painting", needs)


def test_sizes_in_words() -> None:
    assert [in_words(size) for size in (0, 3 * 2**20, GIB, 2345 * GIB)] == ["0 MiB", "3 MiB", "1.0 GiB", "2,345.0 GiB"]
