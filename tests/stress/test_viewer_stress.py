"""Hostile clients of a viewer, for AVATAR_STRESS_MINUTES: a good client is drawn for while they last and after."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

pytest.importorskip("viser")
from lively import lively_run
from view_client import Page, Started, started
from waiting import until
from websockets.exceptions import WebSocketException

MINUTES = float(os.environ.get("AVATAR_STRESS_MINUTES", 0.05))
CLIENTS = 50 if MINUTES >= 1 else 10
SLOWEST = 0.5  # of the rate before
GROWTH = 200  # MiB


def memory(viewer: Started) -> float:
    """Resident, in MiB."""
    status = Path(f"/proc/{viewer.process.pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def files(viewer: Started) -> int:
    """That are open, sockets among them."""
    return len(list(Path(f"/proc/{viewer.process.pid}/fd").iterdir()))


def rate(page: Page, seconds: float = 2.0) -> float:
    """Pictures a second of a motion that plays."""
    page.set("Motion", "neutral face")
    page.set("Motion", "train")
    page.set("Reset face", True)
    page.read(0.3)  # choices and buttons are handled side by side, in any order
    page.set("Pause" if "Pause" in page.controls else "Play", True)
    page.next_picture()
    begin, before = time.monotonic(), page.pictures
    while time.monotonic() - begin < seconds:
        page.read(0.05)
    return (page.pictures - before) / (time.monotonic() - begin)


def longest_wait(address: str, seconds: float) -> float:
    """Of a good client for the picture of a change; it connects again where others have pushed it out."""
    end, longest, value = time.monotonic() + seconds, 0.0, 0.0
    while time.monotonic() < end:
        begin = time.monotonic()
        with suppress(WebSocketException, OSError), Page(address) as page:
            while time.monotonic() < end:
                begin, value = time.monotonic(), 0.3 - value
                page.set("jaw open", value)
                page.next_picture()
                longest = max(longest, time.monotonic() - begin)
                page.read(0.2)
        longest = max(longest, time.monotonic() - begin)
    return longest


@pytest.mark.slow
@pytest.mark.timeout(MINUTES * 60 + 300)
def test_a_viewer_outlives_hostile_clients(tracked_folder: Path, tmp_path: Path) -> None:
    run = lively_run(tracked_folder, tmp_path / "run", "model.uv_size=20")
    log = tmp_path / "stderr"
    with started(run, "--stream", 0, "--size", 96, log=log) as viewer:
        with Page(viewer.page) as page:
            before, used = rate(page), memory(viewer)
        words = [viewer.port, viewer.stream, viewer.token, CLIENTS, MINUTES * 60]
        script = Path(__file__).with_name("hostile_clients.py")
        hostile = subprocess.Popen([sys.executable, script, *map(str, words)], stdout=subprocess.PIPE, text=True)
        waited = longest_wait(viewer.page, MINUTES * 60)
        said, _ = hostile.communicate(timeout=120)
        with Page(viewer.page) as page:
            after = rate(page)
        grown, lines = memory(viewer) - used, log.read_text().splitlines()
        until(lambda: files(viewer) < 30, 60)  # connections that were broken off are closed in time
        print(f"{CLIENTS} hostile clients, {MINUTES:g} minutes; pictures a second: {before:.1f}, then {after:.1f};")
        print(f"{waited:.1f} s at most for one meanwhile; {grown:+.0f} MiB; {len(lines)} lines of stderr:")
        print(*lines, sep="\n")
        assert "let in" not in said and "Traceback" not in "".join(lines)
        assert len(lines) < 40 * (MINUTES + 1) and grown < GROWTH
        assert after > SLOWEST * before
        assert viewer.interrupt() < 10
