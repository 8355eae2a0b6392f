"""Frames on a shelf are those of the subject, decoded once while there is room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from small_runs import open_small, small_config

from avatar.data import loader as loader_module
from avatar.data.gpu_frame_cache import GpuFrameCache, box_of, frame_cache_bytes
from avatar.data.loader import FrameLoader
from avatar.data.subject import Subject
from avatar.losses.metrics import bounding_box

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def subject(tracked_folder: Path) -> Subject:
    return open_small(tracked_folder, small_config())[1]


def bytes_of(subject: Subject, size: int | None = None) -> int:
    return subject.pixels(0, size).nbytes


@pytest.mark.parametrize("size", [None, 24])
def test_frames_are_those_of_the_subject(subject: Subject, size: int | None) -> None:
    frame_cache = GpuFrameCache(subject, CPU, 10 * bytes_of(subject))
    with FrameLoader(subject, size, frame_cache=frame_cache) as loader:
        for index, found in zip([3, 0, 3], loader.frames([3, 0, 3]), strict=True):
            expected = subject.frame(index, size)
            assert (found.index, found.name) == (expected.index, expected.name)
            for name in ("image", "alpha", "head_mask", "mouth_mask"):
                assert torch.equal(getattr(found, name), getattr(expected, name)), name
                assert getattr(found, name).is_contiguous()
            for name, value in vars(found.params).items():
                assert torch.equal(value, getattr(expected.params, name)), name
            assert found.camera.fx == expected.camera.fx and found.camera.width == expected.camera.width
            assert found.head_box == bounding_box(expected.head_mask)


def test_what_fits_is_decoded_once_and_kept_in_one_place(subject: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[int] = []
    pixels = Subject.pixels

    def counted(self: Subject, index: int, size: int | None = None) -> object:
        decoded.append(index)
        return pixels(self, index, size)

    one = bytes_of(subject)
    monkeypatch.setattr(Subject, "pixels", counted)
    frame_cache = GpuFrameCache(subject, CPU, 2 * one)
    with monkeypatch.context() as patch, FrameLoader(subject, frame_cache=frame_cache) as loader:
        patch.setattr(loader_module, "CACHE_BYTES", 0)
        for _ in range(3):
            list(loader.frames([0, 1, 2]))
    assert sorted(decoded) == [0, 1, 2, 2, 2]
    assert [index in frame_cache for index in (0, 1, 2)] == [True, True, False]
    with FrameLoader(subject, frame_cache=GpuFrameCache(subject, CPU, one)) as loader:
        list(loader.frames([0, 1]))
        assert loader.cached_bytes == one


def test_several_threads_decode_in_order(subject: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loader_module, "processor_count", lambda: 4)
    order = [5, 1, 1, 0, 4, 2, 5, 3, 0]
    with FrameLoader(subject, 24, frame_cache=GpuFrameCache(subject, CPU, 3 * bytes_of(subject, 24))) as loader:
        for index, found in zip(order, loader.frames(order), strict=True):
            assert found.index == index and torch.equal(found.image, subject.frame(index, 24).image)


def test_the_box_of_a_mask() -> None:
    mask = np.zeros((6, 9), np.uint8)
    assert box_of(mask) == (slice(0, 0), slice(0, 0))
    mask[2, 3] = mask[4, 7] = 1
    assert box_of(mask) == (slice(2, 5), slice(3, 8))


def test_a_cpu_has_no_shelf_of_its_own() -> None:
    assert frame_cache_bytes(CPU) == 0
