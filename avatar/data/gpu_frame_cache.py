"""Frames on a GPU: as many as fit stay there, as the bytes of their files; the rest come when their turn does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.compute.device import to_device
from avatar.data.frame import Frame
from avatar.data.subject import FramePixels, Subject
from avatar.types import Camera, HeadParams

SHARE = 0.5  # of the memory that is free on the GPU when a training begins


def frame_cache_bytes(device: torch.device) -> int:
    """How much of a GPU's memory frames may take."""
    return int(SHARE * torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else 0


class _Kept(NamedTuple):
    """One frame at one size."""

    flat: UInt8[Tensor, " bytes"]  # on the GPU, one part after the other, so that one division makes floats of all
    head_box: tuple[slice, slice]
    camera: Camera
    params: HeadParams


class GpuFrameCache:
    """The frames of a subject on one GPU, and how they become `Frame`s there, without a number that anybody waits for.

    The first frames that come stay: in every pass over a video all of them come, so which ones does not matter.
    """

    def __init__(self, subject: Subject, device: torch.device, limit_bytes: int) -> None:
        self._subject, self._device = subject, device
        self._room = limit_bytes
        self._kept: dict[int, _Kept] = {}
        tracks = subject.recording.tracks
        self._tracks = {name: to_device(tracks[name], device) for name in HeadParams.__dataclass_fields__}

    def __contains__(self, index: int) -> bool:
        return index in self._kept

    def frame(self, index: int, pixels: FramePixels | None, size: int | None) -> Frame:
        """A frame decoded at `size`, always the same one; its pixels may be None where the cache holds it."""
        recording = self._subject.recording
        time = recording.time(index)
        kept = self._kept.get(index)
        if kept is None:
            assert pixels is not None
            flat = torch.from_numpy(np.concatenate([part.reshape(-1) for part in pixels]))
            params = HeadParams(**{name: track[time] for name, track in self._tracks.items()})
            camera = self._subject.camera(index, size)
            kept = _Kept(to_device(flat, self._device), box_of(pixels.head_mask), camera, params)
            if flat.nbytes <= self._room:
                self._room -= flat.nbytes
                self._kept[index] = kept
        image, alpha, head_mask, mouth_mask = planes(kept.flat, kept.camera.height, kept.camera.width)
        return Frame(
            index=index,
            name=recording.names[index],
            camera=kept.camera,
            params=kept.params,
            image=image,
            alpha=alpha,
            head_mask=head_mask,
            mouth_mask=mouth_mask,
            head_box=kept.head_box,
            shared_time=None if recording.rig is None else time,
        )


def planes(flat: UInt8[Tensor, " bytes"], height: int, width: int) -> tuple[Float[Tensor, "..."], ...]:
    """Image [H, W, 3] and three masks [H, W] of a frame's bytes, in [0, 1]."""
    values, size = flat / 255.0, height * width
    masks = values[3 * size :].view(3, height, width).unbind()
    return values[: 3 * size].view(height, width, 3), *masks


def box_of(mask: UInt8[np.ndarray, "H W"]) -> tuple[slice, slice]:
    """Rows and columns that hold every value above 0; empty where there is none."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if len(rows) == 0:
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
