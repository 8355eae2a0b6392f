"""Parts of a tracking that stand still: told only where others move and the head model can move them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from heads import grid_head
from some_tracks import track

from avatar.head.assets import HeadAssets
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.constant_parameters import FEWEST, constant_parameters

HEAD = grid_head()
MOVING = [track(expression=np.array([0.1 * n, 0.0, 0.0, 0.0])) for n in range(FEWEST)]


def still(tracks: list[FrameTrack], head: HeadAssets = HEAD) -> dict[str, bool]:
    """By part: whether it is at rest."""
    return {part.part: part.is_absent for part in constant_parameters(tracks, head)}


def test_every_part_but_the_one_that_moves_stands_still() -> None:
    assert still(MOVING) == {"head pose": False, "jaw": True, "gaze": True, "eyelids": True}
    held = [replace(one, eyelids=np.array([0.0, 0.2])) for one in MOVING]
    assert not still(held)["eyelids"]


def test_what_the_head_model_cannot_move_and_too_few_frames_and_one_repeated_are_not_judged() -> None:
    head = replace(HEAD, weights=HEAD.weights * torch.tensor([1.0, 1, 0, 1, 1]), eyelid_dirs=HEAD.eyelid_dirs * 0)
    assert still(MOVING, head).keys() == {"head pose", "gaze"}
    assert still(MOVING[1:]) == {} and still(MOVING[:1] * FEWEST) == {}
