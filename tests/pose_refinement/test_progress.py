"""What a refinement has found so far stays until its result is written."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from drawn_clip import BACKGROUND, SIZE, drawn_clip, patterned_avatar

from avatar.data.subject import Subject
from avatar.pose_refinement import refine_subject as refine_module
from avatar.pose_refinement.progress import read_progress, write_progress
from avatar.pose_refinement.refine_subject import refine_subject


def test_progress_of_a_frame_without_a_head_is_read_back(tmp_path: Path) -> None:
    moves, figures = [torch.ones(3), torch.zeros(3)], [(0.1, 20.0, 21.0), (math.nan, math.nan, math.nan)]
    write_progress(tmp_path / "progress", "key", moves, figures)
    found, told = read_progress(tmp_path / "progress", "key", 3)
    assert torch.stack(found).equal(torch.stack(moves)) and told[0] == figures[0]
    assert len(told) == 2 and all(math.isnan(value) for value in told[1])


def test_an_interruption_while_it_finishes_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does whatever goes wrong before the result is written."""
    avatar = patterned_avatar(tmp_path)
    clip = cast(Subject, drawn_clip(avatar))
    said: list[str] = []
    finish, is_late = refine_module._Work.finish, [False]

    def late(self: Any, *words: Any) -> Any:
        is_late[0] = True
        return finish(self, *words)

    @contextmanager
    def interrupted() -> Iterator[Any]:
        yield lambda: is_late[0]

    with monkeypatch.context() as patch:
        patch.setattr(refine_module._Work, "finish", late)
        patch.setattr(refine_module, "interruption", interrupted)
        assert refine_subject(avatar, clip, SIZE, BACKGROUND, tmp_path / "progress", said.append) is None
    for _ in range(2):
        assert refine_subject(avatar, clip, SIZE, BACKGROUND, tmp_path / "progress", said.append) is not None
        assert said.pop().startswith(f"going on after {len(clip)} of {len(clip)} frames")
