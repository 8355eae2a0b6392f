from __future__ import annotations

from pathlib import Path

import pytest

from avatar.compute import memory
from avatar.compute.memory import Need, available_memory, check_memory, in_words
from avatar.errors import UserError

GIB = 2**30
MEMINFO = (
    "MemTotal: 24683656 kB\nMemFree: 100 kB\nMemAvailable:   8388608 kB\nSwapFree: 1048576 kB\nHugePages_Total: 0\n"
)


def machine(root: Path, groups: str = "") -> Path:
    """A root folder with 9 GiB in /proc/meminfo, of a process in these control groups."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/meminfo").write_text(MEMINFO)
    (root / "proc/self/cgroup").write_text(groups)
    return root


def group(root: Path, path: str, version: int, limit: str, used: int, cached: int = 0) -> None:
    names = ("memory.max", "memory.current") if version == 2 else ("memory.limit_in_bytes", "memory.usage_in_bytes")
    folder = root / "sys/fs/cgroup" / path
    folder.mkdir(parents=True, exist_ok=True)
    (folder / names[0]).write_text(f"{limit}\n")
    (folder / names[1]).write_text(f"{used}\n")
    statistics = "inactive_file" if version == 2 else "total_inactive_file"
    (folder / "memory.stat").write_text(f"anon 5\n{statistics} {cached}\n")


def test_what_linux_can_give_is_what_it_can_free_and_swap(tmp_path: Path) -> None:
    assert available_memory(machine(tmp_path)) == 9 * GIB


def test_a_container_allows_less(tmp_path: Path) -> None:
    """Its own group has no limit; the one above has 4 GiB, of which 1 is used, and a half of that can be freed."""
    root = machine(tmp_path, "0::/system.slice/job\n")
    group(root, "system.slice/job", 2, "max", 10)
    group(root, "system.slice", 2, str(4 * GIB), GIB, GIB // 2)
    assert available_memory(root) == 3.5 * GIB
    group(root, "system.slice/job", 2, str(2 * GIB), 3 * GIB)
    assert available_memory(root) == 0


def test_a_container_of_the_first_version_that_sees_itself_as_the_root(tmp_path: Path) -> None:
    root = machine(tmp_path, "9:cpu,cpuacct:/docker/abc\n4:cpuset,memory:/docker/abc\nnonsense\n")
    group(root, "memory", 1, str(2 * GIB), GIB // 4)
    assert available_memory(root) == 1.75 * GIB
    group(root, "memory", 1, str(2**63 - 4096), GIB)
    assert available_memory(root) == 9 * GIB


def test_without_linux_it_is_what_the_machine_has_and_without_that_nothing_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages = {"SC_PHYS_PAGES": 1000, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr(memory.os, "sysconf", pages.__getitem__, raising=False)
    assert available_memory(tmp_path) == 4096000
    monkeypatch.delattr(memory.os, "sysconf")
    assert available_memory(tmp_path) is None


def test_this_machine_has_some() -> None:
    found = available_memory()
    assert found is None or found > 2**27


def test_too_much_is_refused_with_both_figures_and_what_to_lower(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = [Need("the paint", 3 * GIB, "--paint"), Need("the canvas", 12 * GIB, "--size")]
    check_memory("painting", needs, 15 * GIB)
    with pytest.raises(UserError) as caught:
        check_memory("painting", needs, 15 * GIB - 1)
    assert str(caught.value) == (
        "painting needs about 15.0 GiB of memory, and 15.0 GiB are available; the canvas takes 12.0 GiB of it: lower --size"
    )
    monkeypatch.setattr(memory, "available_memory", lambda: None)
    check_memory("painting", needs)
    monkeypatch.setattr(memory, "available_memory", lambda: GIB)
    with pytest.raises(UserError, match="and 1.0 GiB are available"):
        check_memory("painting", needs)


def test_sizes_in_words() -> None:
    assert [in_words(size) for size in (0, 3 * 2**20, GIB, 2345 * GIB)] == ["0 MiB", "3 MiB", "1.0 GiB", "2,345.0 GiB"]
