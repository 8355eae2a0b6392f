"""Parts of a clip computed side by side: the same results, by several threads of one core each."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import torch
from test_terms import COLUMNS, IDENTITIES, IDENTITY, T, landmark_term, photometric_term, some_motion

from data_prep.track.fit import landmark_term as landmarks
from data_prep.track.fit import photometric_term as pictures
from data_prep.track.fit.chunks import chunks_of, over_chunks, side_by_side
from data_prep.track.fit.normal_equations import NormalEquations


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    monkeypatch.delenv("AVATAR_THREADS", raising=False)
    yield
    torch.set_num_threads(before)


def test_chunks_cover_the_frames_once() -> None:
    assert list(chunks_of(7, 3)) == [slice(0, 3), slice(3, 6), slice(6, 7)]
    assert list(chunks_of(0, 3)) == []
    assert over_chunks(lambda chunk: chunk.start, 7, 3) == [0, 3, 6]


def test_two_chunks_are_made_at_the_same_time_by_one_core_each(two_threads: None) -> None:
    meeting = threading.Barrier(2, timeout=20)
    here = threading.get_ident()

    def meet(chunk: slice) -> tuple[int, int, bool]:
        meeting.wait()  # would never end in one thread
        return chunk.start, torch.get_num_threads(), threading.get_ident() != here

    with side_by_side():
        assert torch.get_num_threads() == 1
        assert over_chunks(meet, 4, 2) == [(0, 1, True), (2, 1, True)]
    assert torch.get_num_threads() == 2
    assert over_chunks(lambda _: threading.get_ident(), 2, 1) == [here, here]


def test_what_goes_wrong_in_a_chunk_is_raised_and_threads_come_back(two_threads: None) -> None:
    def fail(chunk: slice) -> None:
        raise ArithmeticError(f"chunk {chunk.start}")

    with pytest.raises(ArithmeticError, match="chunk 0"), side_by_side():
        over_chunks(fail, 4, 2)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(
    ("make", "module", "shared"),
    [(landmark_term, landmarks, 0), (landmark_term, landmarks, IDENTITIES), (photometric_term, pictures, 0)],
)
def test_terms_are_the_same_to_the_bit(make, module, shared: int, two_threads, monkeypatch) -> None:
    monkeypatch.setattr(module, "_FRAMES_AT_ONCE", 2)
    term, motion = make(), some_motion()

    def equations() -> tuple[NormalEquations, float]:
        found = NormalEquations.zeros(T, COLUMNS, shared)
        term.add_to(found, IDENTITY, motion)
        return found, term.cost(IDENTITY, motion)

    torch.set_num_threads(1)  # as side by side: two threads that share a product may round it otherwise than one
    one, cost = equations()
    torch.set_num_threads(2)
    with side_by_side():
        for _ in range(3):
            two, same_cost = equations()
            assert cost == same_cost and one.diagonal.any()
            for name in ("diagonal", "gradient", "border", "shared", "shared_gradient"):
                assert torch.equal(getattr(one, name), getattr(two, name)), name
