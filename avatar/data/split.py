"""The train/test split, and its rule for a clip that says nothing of its own: the last frames are held out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from avatar.errors import UserError

TEST_FRAMES, TRAIN_FRAMES = 500, 2000  # FlashAvatar's protocol for clips that are long enough for it
SHORT_CLIP_TRAIN_FRACTION = 0.8
Item = TypeVar("Item")


class Split(NamedTuple):
    train: tuple[int, ...]  # indices into the prepared subject, increasing
    test: tuple[int, ...]

    def to_lists(self) -> list[list[int]]:
        """As JSON has it."""
        return [list(self.train), list(self.test)]


def check_divided(split: Split) -> None:
    """Raises UserError for a subject of a single frame or time, which is enough to drive an avatar."""
    if not split.test:
        if len(split.train) > 1:
            raise UserError(
                f"the {len(split.train)} pictures are all of one time; at least 2 times are needed, one to train and one "
                "to test"
            )
        split_frames(len(split.train))


def split_frames(count: int, test_frames: int | None = None) -> Split:
    """The last frames test, as many as `test_frames` says if it is given; those right before them train.

    With 2,500 frames or more: the last 500 test, up to 2,000 before them train (FlashAvatar, HyperGaussians). Shorter
    clips: the first 80% train, the rest test. Raises UserError when either part would be empty.
    """
    if count < 2:
        raise UserError(f"the subject has {count} usable frame(s); at least 2 are needed, one to train and one to test")
    is_long = count >= TEST_FRAMES + TRAIN_FRAMES
    if test_frames is not None:
        test = test_frames
    elif is_long:
        test = TEST_FRAMES
    else:
        test = count - int(count * SHORT_CLIP_TRAIN_FRACTION)
    if not 1 <= test < count:
        raise UserError(f"{test} test frames cannot be held out of {count}: choose from 1 to {count - 1}")
    available = count - test
    train = min(available, TRAIN_FRAMES) if is_long else available
    return Split(tuple(range(available - train, available)), tuple(range(available, count)))


def evenly_spread(items: Sequence[Item], count: int) -> list[Item]:
    """`count` of the items, from the first to the last; all where there are fewer."""
    places = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[i] for i in places.tolist()]
