"""Frames in order, whatever the cache and the number of workers; bounded memory; errors at their turn."""

from __future__ import annotations

import itertools
import threading
from pathlib import Path

import pytest
import torch
from tracked_folder import write_tracked_folder

from avatar.data import loader as loader_module
from avatar.data.loader import FrameLoader
from avatar.data.source import Source
from avatar.data.subject import FramePixels, Subject
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.prepare.prepare import prepare

ORDER = [3, 0, 0, 7, 3, 11, 1, 2, 3, 0, 5, 11]
FRAME_BYTES = 64 * 64 * 6


@pytest.fixture
def subject(tmp_path: Path) -> Subject:
    folder = write_tracked_folder(tmp_path / "subject", frames=12)
    head_path = folder / "head_model"
    return Subject.open(
        prepare(Source(folder, head_path, frame_offset=1), load_head_assets(head_path), out=tmp_path / "out", say=str)
    )


@pytest.mark.parametrize("cached_frames", [0, 1, 3, 100])
def test_order_and_contents(cached_frames: int, subject: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loader_module, "CACHE_BYTES", cached_frames * 32 * 32 * 6)
    with FrameLoader(subject, size=32) as loader:
        for _ in range(2):
            frames = list(loader.frames(ORDER))
            assert [frame.index for frame in frames] == ORDER
            for frame in frames:
                expected = subject.frame(frame.index, 32)
                assert torch.equal(frame.image, expected.image) and torch.equal(frame.mouth_mask, expected.mouth_mask)


def test_memory_is_bounded_and_used(subject: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[int] = []
    decode = Subject.pixels

    def counted(self: Subject, index: int, size: int | None = None) -> FramePixels:
        decoded.append(index)
        return decode(self, index, size)

    monkeypatch.setattr(Subject, "pixels", counted)
    monkeypatch.setattr(loader_module, "CACHE_BYTES", 12 * FRAME_BYTES)
    with FrameLoader(subject) as loader:
        for _ in loader.frames(itertools.islice(itertools.cycle(range(12)), 60)):
            assert loader.cached_bytes <= 12 * FRAME_BYTES
        assert sorted(decoded) == list(range(12)), "every frame is decoded once"
        assert loader.cached_bytes == 12 * FRAME_BYTES
    decoded.clear()
    monkeypatch.setattr(loader_module, "CACHE_BYTES", 4 * FRAME_BYTES)
    with FrameLoader(subject) as loader:
        for _ in loader.frames(itertools.islice(itertools.cycle(range(12)), 60)):
            assert loader.cached_bytes <= 4 * FRAME_BYTES
    assert len(decoded) == 60, "a cycle longer than the cache finds nothing in it"


def test_endless_orders_are_read_only_a_little_ahead(subject: Subject) -> None:
    asked: list[int] = []

    def order():
        for i in itertools.count():
            asked.append(i)
            yield i % 12

    with FrameLoader(subject) as loader:
        frames = loader.frames(order())
        assert [next(frames).index for _ in range(20)] == [i % 12 for i in range(20)]
        assert len(asked) <= 20 + 3


def test_a_broken_file_raises_at_its_turn(subject: Subject) -> None:
    broken = Path(subject.manifest.source) / subject.manifest.frames[5].image
    broken.write_bytes(broken.read_bytes()[:100])
    with FrameLoader(subject) as loader:
        frames = loader.frames([1, 2, 5, 3])
        assert [next(frames).index for _ in range(2)] == [1, 2]
        with pytest.raises(UserError, match=r"imgs/00006\.jpg is cut short"):
            next(frames)
        assert next(loader.frames([3])).index == 3, "the loader itself goes on"


def test_closing_stops_the_thread(subject: Subject) -> None:
    before = threading.active_count()
    loader = FrameLoader(subject)
    frames = loader.frames(range(12))
    next(frames)
    assert threading.active_count() > before
    loader.close()
    frames.close()
    assert threading.active_count() == before and loader.cached_bytes == 0
    with pytest.raises(RuntimeError, match="the frame loader is closed"):
        next(loader.frames([0]))
