"""Two writers of one file: each has a temporary file of its own, and what stands in the end is whole."""

from __future__ import annotations

import os
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from avatar.files.atomic import temporary_name, whole_folder, write_atomically


def test_two_writers_at_once_never_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both have written and neither has renamed when they meet."""
    file, meeting, sync = tmp_path / "run.json", threading.Barrier(2, timeout=20), os.fsync
    monkeypatch.setattr(os, "fsync", lambda descriptor: (sync(descriptor), meeting.wait()))
    contents = [b"first " * 5000, b"second" * 7000]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda content: write_atomically(file, content), contents))
    assert file.read_bytes() in contents
    assert list(tmp_path.iterdir()) == [file]


def test_another_process_has_other_temporary_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forked, it counts from the same number."""
    from avatar.files import atomic

    names = set()
    for process in (1, 2):
        monkeypatch.setattr(os, "getpid", lambda process=process: process)
        monkeypatch.setattr(atomic, "_COUNTER", iter((7,)))
        names.add(temporary_name(tmp_path / "clip.mp4").name)
    assert len(names) == 2 and all(name.startswith(".clip.") and name.endswith(".mp4") for name in names)


def test_a_folder_is_as_open_as_the_users_other_folders(tmp_path: Path) -> None:
    for mask, mode in ((0o077, 0o700), (0o027, 0o750)):
        before = os.umask(mask)
        try:
            with whole_folder(tmp_path / f"{mask:o}"):
                pass
            assert (tmp_path / f"{mask:o}").stat().st_mode & 0o777 == mode
            assert os.umask(mask) == mask
        finally:
            os.umask(before)


def test_left_overs_are_looked_for_once_in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dead = tmp_path / re.sub(r"-[0-9]+-[0-9]+\.partial", f"-{2**30}-0.partial", temporary_name(tmp_path / "a.png").name)
    own = temporary_name(tmp_path / "b.png")
    for file in (dead, own):
        file.touch()
    listed, iterdir = [], Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda folder: (listed.append(folder), iterdir(folder))[1])
    for number in range(3):
        write_atomically(tmp_path / f"{number}.png", b"picture")
    assert listed == [tmp_path]
    assert not dead.exists() and own.exists()


def test_what_a_dead_process_of_the_same_number_left_is_no_obstacle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a container that is killed and starts again: its processes have the same numbers, and count from 0."""
    from avatar.files import atomic

    file = tmp_path / "run.json"
    monkeypatch.setattr(atomic, "_COUNTER", iter((7,)))
    left = temporary_name(file)
    left.write_bytes(b"a part")
    monkeypatch.setattr(atomic, "_COUNTER", iter((7, 8)))
    write_atomically(file, b"all of it")
    assert file.read_bytes() == b"all of it" and left.read_bytes() == b"a part"
    assert set(tmp_path.iterdir()) == {file, left}
