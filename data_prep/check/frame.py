"""One frame of a folder that has been checked but not prepared, decoded."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.frame import Frame
from avatar.data.images import read_image
from avatar.data.subject import head_of_matte
from avatar.types import Camera
from data_prep.check.clip import Clip
from data_prep.check.coverage import Coverage
from data_prep.formats.frame_files import ALPHA
from data_prep.prepare.masks import read_masks
from data_prep.prepare.projection import head_params


def first_training_frame(clip: Clip, coverage: Coverage) -> tuple[Frame, Float[Tensor, " S"]]:
    """The frame, and the identity of its person."""
    identity = torch.from_numpy(next(iter(clip.tracking.frames.values())).shape[:300].astype(np.float32))
    return _frame(clip, coverage.images[coverage.split.train[0]]), identity


def _frame(clip: Clip, number: int) -> Frame:
    track = dict(clip.tracked())[number]
    files = clip.files
    image = read_image(files.images[number])
    height, width = image.shape[:2]
    alpha = files.read(ALPHA, number)
    if alpha is None:
        alpha = np.full((height, width), 255, np.uint8)
    head, mouth = read_masks(files, number)
    if head is None or not (files.head_masks or files.parsing):
        head = head_of_matte(alpha)
    mouth = np.zeros_like(alpha) if mouth is None else mouth
    R, t = (torch.from_numpy(value).float() for value in (track.R, track.t))
    fx, fy, cx, cy = track.intrinsics.tolist()
    planes = [torch.from_numpy(pixels).float() / 255 for pixels in (image, alpha, head, mouth)]
    return Frame(
        index=0,
        name=files.images[number].stem,
        camera=Camera(R, t, fx, fy, cx, cy, width, height),
        params=head_params(track),
        image=planes[0],
        alpha=planes[1],
        head_mask=planes[2],
        mouth_mask=planes[3],
    )
