from __future__ import annotations

import dataclasses
from collections import Counter
from itertools import islice

import pytest
from small_runs import small_config

from avatar.train.frame_order import frame_order, within_epochs


@pytest.mark.parametrize(("passes", "steps"), [(None, 12), (1, 5), (2, 10), (3, 12)])
def test_passes_limit_the_steps_where_frames_are_few(passes: int | None, steps: int) -> None:
    asked = small_config(f"trainer.max_epochs={'null' if passes is None else passes}").trainer
    given = within_epochs(asked, frames=5)
    assert given.iterations == steps
    assert dataclasses.replace(given, iterations=12) == asked


def test_every_pass_sees_every_frame_once_in_a_new_order() -> None:
    frames = [3, 5, 8, 13, 21]
    order = list(frame_order(frames, seed=1, start=0, stop=15))
    passes = [order[i : i + 5] for i in (0, 5, 10)]
    assert all(sorted(p) == frames for p in passes)
    assert len({tuple(p) for p in passes}) > 1


def test_a_resumed_run_sees_what_the_uninterrupted_one_does() -> None:
    frames = list(range(7))
    whole = list(frame_order(frames, seed=4, start=0, stop=40))
    assert list(frame_order(frames, seed=4, start=0, stop=23)) + list(frame_order(frames, 4, 23, 40)) == whole
    assert list(frame_order(frames, seed=5, start=0, stop=40)) != whole
    assert max(Counter(whole).values()) - min(Counter(whole).values()) <= 1


def test_no_list_of_all_steps_is_made() -> None:
    """A hundred million of them would not fit; a few are taken, so a few are looked up."""
    looked_up: list[int] = []

    class Frames(list[int]):
        def __getitem__(self, index):
            looked_up.append(index)
            return super().__getitem__(index)

    order = frame_order(Frames(range(5)), seed=0, start=0, stop=10_000)
    assert len(list(islice(order, 12))) == len(looked_up) == 12
