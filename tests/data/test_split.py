from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar.data.split import split_frames
from avatar.errors import UserError


@pytest.mark.parametrize(
    ("count", "train", "test"),
    [
        (2, range(1), range(1, 2)),
        (3, range(2), range(2, 3)),
        (10, range(8), range(8, 10)),
        (1000, range(800), range(800, 1000)),
        (2499, range(1999), range(1999, 2499)),
        (2500, range(2000), range(2000, 2500)),
        (4000, range(1500, 3500), range(3500, 4000)),
    ],
)
def test_the_rule(count: int, train: range, test: range) -> None:
    assert split_frames(count) == (tuple(train), tuple(test))


def test_a_number_of_test_frames_that_the_user_chooses() -> None:
    assert split_frames(100, 10) == (tuple(range(90)), tuple(range(90, 100)))
    assert split_frames(4000, 350)[0] == tuple(range(1650, 3650))


@given(st.integers(2, 6000), st.none() | st.integers(-3, 7000))
def test_never_empty_never_overlapping(count: int, test: int | None) -> None:
    try:
        split = split_frames(count, test)
    except UserError as error:
        assert "choose from 1 to" in str(error)
        assert test is not None, "the rule itself always has an answer"
        return
    frames = split.train + split.test
    assert frames == tuple(range(frames[0], count)) and split.train and split.test
    assert test in (None, len(split.test))


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_frames(count: int) -> None:
    with pytest.raises(UserError, match=f"has {count} usable frame"):
        split_frames(count)
