"""Single frames of tracking, made up."""

from __future__ import annotations

from typing import Any

import numpy as np

from avatar.types import IDENTITY_6D
from data_prep.formats.frame_track import FrameTrack
from data_prep.formats.root_pose import rotation_matrix

AHEAD = np.diag([1.0, -1.0, -1.0])  # the head looks along +z with y up, a camera sees y down


def track(turn: tuple[float, float, float] = (0.0, 0.0, 0.0), **values: Any) -> FrameTrack:
    """A head 0.8 metres before a camera of 64 x 64 pixels, turned by degrees about its own axes."""
    rest = np.array(IDENTITY_6D)
    given = {
        "expression": np.zeros(4),
        "jaw": rest,
        "eyes": np.tile(rest, 2),
        "eyelids": np.zeros(2),
        "neck": rest,
        "R": AHEAD @ rotation_matrix(np.radians(turn)),
        "t": np.array([0.0, 0.0, 0.8]),
        "shape": np.zeros(2),
        "intrinsics": np.array([160.0, 160.0, 32.0, 32.0]),
        "size": (64, 64),
    }
    return FrameTrack(**{**given, **values})
