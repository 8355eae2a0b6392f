"""One frame of a folder that has been checked but not prepared, decoded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.images import read_image, read_mask
from avatar.types import Camera, Frame
from data_prep.check.clip import Clip
from data_prep.check.coverage import Coverage
from data_prep.projection import head_params


def first_training_frame(clip: Clip, coverage: Coverage) -> tuple[Frame, Float[Tensor, " S"]]:
    """The frame, and the identity of its person."""
    identity = torch.from_numpy(next(iter(clip.tracking.frames.values())).shape[:300].astype(np.float32))
    return _frame(clip, coverage.images[coverage.split.train[0]]), identity


def _frame(clip: Clip, number: int) -> Frame:
    track = dict(clip.tracked())[number]
    image = torch.from_numpy(read_image(clip.files.images[number])).float() / 255
    height, width = image.shape[:2]

    def mask(found: dict[int, Path], default: float) -> torch.Tensor:
        if number not in found:
            return torch.full((height, width), default)
        return torch.from_numpy(read_mask(found[number])).float() / 255

    R, t = (torch.from_numpy(value).float() for value in (track.R, track.t))
    fx, fy, cx, cy = track.intrinsics.tolist()
    files = clip.files
    return Frame(
        index=0,
        name=files.images[number].stem,
        camera=Camera(R, t, fx, fy, cx, cy, width, height),
        params=head_params(track),
        image=image,
        alpha=mask(files.alphas, 1.0),
        head_mask=mask(files.head_masks, 1.0),
        mouth_mask=mask(files.mouth_masks, 0.0),
    )
