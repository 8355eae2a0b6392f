"""Subjects whose held-out frames are noise: whatever is learned from them shows in the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace

import numpy as np
import torch
from drawn_clip import Clip
from torch import Tensor

from avatar.data.recording import Recording
from avatar.data.subject import FramePixels, Subject
from avatar.pose_refinement.tracking_values import rotation


class _Poisoned(Subject):
    """Noise in place of every held-out picture and mask."""

    def pixels(self, index: int, size: int | None = None) -> FramePixels:
        pixels = super().pixels(index, size)
        if index not in self.split.test:
            return pixels
        rng = np.random.default_rng([7, index])
        return FramePixels(*(rng.integers(0, 256, plane.shape, np.uint8) for plane in pixels))


def poisoned(subject: Subject) -> Subject:
    """The subject with noise in its held-out pictures, masks and tracking."""
    own = {field.name: getattr(subject, field.name) for field in fields(Subject)}
    return _Poisoned(**{**own, "recording": poisoned_recording(subject.recording)})


def poisoned_clip(clip: Clip) -> Clip:
    """The same for a clip in memory."""
    recording, generator = poisoned_recording(clip.recording), torch.Generator().manual_seed(7)
    pictures = list(clip.pictures)
    for index in clip.split.test:
        planes = {
            name: torch.rand(getattr(pictures[index], name).shape, generator=generator)
            for name in ("image", "alpha", "head_mask", "mouth_mask")
        }
        where = {"camera": recording.camera(index), "params": recording.params(index)}
        pictures[index] = replace(pictures[index], **planes, **where)
    return replace(clip, recording=recording, pictures=tuple(pictures))


def poisoned_recording(recording: Recording) -> Recording:
    return replace(recording, tracks=poisoned_tracks(recording.tracks, recording.split.test))


def poisoned_tracks(tracks: Mapping[str, Tensor], frames: Sequence[int]) -> dict[str, Tensor]:
    """The tracks with noise in these frames; heads stay before the camera."""
    generator = torch.Generator().manual_seed(7)
    chosen, found = list(frames), {name: values.clone() for name, values in tracks.items()}

    def noise(*shape: int) -> Tensor:
        return torch.randn(len(chosen), *shape, generator=generator)

    found["expression"][chosen] = 3.0 * noise(found["expression"].shape[1])
    found["eyelids"][chosen] = noise(2)
    for name, joints in (("neck", 1), ("jaw", 1), ("eyes", 2)):
        found[name][chosen] = rotation(noise(joints, 3))[..., :2, :].reshape(len(chosen), 6 * joints)
    found["R"][chosen] = rotation(noise(3)) @ found["R"][chosen]
    found["t"][chosen] += 0.1 * noise(3)
    return found
