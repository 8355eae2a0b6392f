"""`avatar train --view`: a viewer that starts with the first checkpoint and outlives a training that ends well."""

from __future__ import annotations

import signal
import socket
from pathlib import Path

import pytest

pytest.importorskip("viser")
from command_line import running
from small_runs import SMALL
from view_client import Page, Started

from avatar.commands import train_view
from avatar.errors import UserError
from avatar.pipeline import INTERRUPTED
from avatar.runs.avatar_file import AVATAR_FILE


@pytest.mark.slow
def test_a_training_is_shown_until_ctrl_c(tracked_folder: Path, tmp_path: Path) -> None:
    words = ("train", tracked_folder, "--out", tmp_path / "run", "--frame-offset", 1, "--view", *SMALL)
    with running(*words, until="Ctrl-C") as (process, said):
        viewer = Started(process, said)
        with Page(viewer.page) as page:
            page.until(lambda: "Step 12 of 12: finished" in str(page.values))
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", viewer.port))


class FakeViewer:
    def __init__(self, words: list[str]) -> None:
        self.words, self.is_ended = words, False
        started.append(self)

    def terminate(self) -> None:
        self.is_ended = True

    def wait(self) -> None:
        assert self.is_ended, "nobody would end it"


started: list[FakeViewer] = []


@pytest.mark.parametrize("has_avatar", [True, False])
def test_a_training_that_fails_ends_its_viewer(
    has_avatar: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_view.subprocess, "Popen", FakeViewer)
    started.clear()
    if has_avatar:
        (tmp_path / AVATAR_FILE).touch()
    assert train_view.train_in_view(tmp_path, Path("head"), lambda: INTERRUPTED) == INTERRUPTED

    def fail() -> int:
        raise UserError("no")

    with pytest.raises(UserError):
        train_view.train_in_view(tmp_path, None, fail)
    assert len(started) == 2 * has_avatar and all(viewer.is_ended for viewer in started)
    assert not has_avatar or started[0].words[3:] == ["view", str(tmp_path), "--port", "0", "--head", "head"]
