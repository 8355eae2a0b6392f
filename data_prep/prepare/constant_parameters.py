"""Parts of a tracking that do not move while others do: the tracker left them at their start, or has no place for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from avatar.head.assets import JOINT_NAMES, HeadAssets
from avatar.types import IDENTITY_6D
from data_prep.formats.frame_track import FrameTrack

FEWEST = 6  # frames
STILL = 1e-4  # range over the clip, of coefficients and of rotation matrices' entries
_JAW = JOINT_NAMES.index("jaw")


class ConstantParameter(NamedTuple):
    part: str
    is_absent: bool  # at rest, as trackers leave it that have no place for it
    sentence: str


def constant_parameters(tracks: Sequence[FrameTrack], head: HeadAssets) -> list[ConstantParameter]:
    """The parts that are the same in all frames while others move; all of them that the head model can move are judged."""
    if len(tracks) < FEWEST:
        return []
    rest = np.array(IDENTITY_6D)
    has_jaw, has_lids = bool((head.weights[:, _JAW] > 0).any()), bool(head.eyelid_dirs.any())
    parts = {
        "head pose": (
            _stack(tracks, "R", "t"),
            None,
            "the head does not move: was the pose fixed when it was tracked?",
        ),
        "expression": (_stack(tracks, "expression"), None, "the face does not move: was the expression fixed?"),
        "jaw": (_stack(tracks, "jaw") if has_jaw else None, rest, "only the expression can open the mouth"),
        "gaze": (_stack(tracks, "eyes"), np.tile(rest, 2), "the avatar's eyes will not turn"),
        "eyelids": (
            _stack(tracks, "eyelids") if has_lids else None,
            np.zeros(2),
            "only the expression can close the eyes",
        ),
    }
    moving = {
        name: bool(np.ptp(values, axis=0).max() > STILL) for name, (values, _, _) in parts.items() if values is not None
    }
    if not any(moving.values()):
        return []  # every frame repeats the first, which is judged elsewhere
    found = []
    for name, (values, at_rest, consequence) in parts.items():
        if values is None or moving[name]:
            continue
        is_absent = at_rest is not None and np.abs(values[0] - at_rest).max() < STILL
        verb = "are" if name == "eyelids" else "is"
        place = "at rest" if is_absent else "the same"
        found.append(
            ConstantParameter(
                name, is_absent, f"the tracked {name} {verb} {place} in all {len(tracks)} frames: {consequence}"
            )
        )
    return found


def _stack(tracks: Sequence[FrameTrack], *names: str) -> np.ndarray:
    return np.stack([np.concatenate([getattr(track, name).ravel() for name in names]) for track in tracks])
