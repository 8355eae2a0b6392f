"""A clip whose pictures the avatar itself has drawn, so that the tracking which fits them is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from small_runs import small_config
from tracked_folder import write_head_model

from avatar.data.frame import Frame
from avatar.data.recording import Recording
from avatar.data.split import Split
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement.tracking_values import (
    EXPRESSION,
    EYELIDS,
    EYES,
    JAW,
    POSE,
    SHIFT,
    TURN,
    moved_tracks,
    values_of,
)
from avatar.runs.model_registry import make_avatar
from avatar.splat.sh import C0
from avatar.types import IDENTITY_6D

EXPRESSIONS = 6
BACKGROUND = torch.ones(3)
SIZE = 72


@dataclass(frozen=True)
class Clip:
    """What refinement uses of a `Subject`, with frames in memory."""

    recording: Recording
    pictures: tuple[Frame, ...]
    manifest: Any
    data_hash: str = "0" * 64

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def split(self) -> Split:
        return self.recording.split

    def image_size(self, size: int | None) -> tuple[int, int]:
        return self.recording.image_size(size)

    def frame(self, index: int, size: int | None) -> Frame:
        assert size == SIZE
        return self.pictures[index]


def patterned_avatar(folder: Path, *overrides: str) -> Avatar:
    """An avatar that is opaque and has a pattern all over, whose colours depend on where they are seen from."""
    assets = write_head_model(folder, EXPRESSIONS)
    torch.manual_seed(0)
    config = small_config("model.uv_size=48", "model.initial_opacity=0.8", *overrides)
    avatar = make_avatar(assets, torch.tensor([0.5, -0.3]), config.model)
    places = avatar.embedding.points(avatar.head.neutral_vertices())
    pattern = 0.5 + 0.35 * torch.sin(150.0 * places + torch.tensor([0.0, 1.0, 2.0]))
    with torch.no_grad():
        avatar.sh_dc[:, 0] = (pattern - 0.5) / C0
        avatar.sh_rest.normal_(std=0.05)
    return avatar.eval()


def true_tracks(frames: int) -> dict[str, torch.Tensor]:
    """Smooth motion of everything that may move; the neck is at rest."""
    time = torch.arange(frames, dtype=torch.float32)
    wave = torch.stack([torch.sin(0.35 * time + k) for k in range(24)], dim=1)
    rest = {
        "expression": torch.zeros(frames, EXPRESSIONS),
        "jaw": torch.tensor(IDENTITY_6D).repeat(frames, 1),
        "eyes": torch.tensor(IDENTITY_6D).repeat(frames, 2),
        "eyelids": torch.zeros(frames, 2),
        "neck": torch.tensor(IDENTITY_6D).repeat(frames, 1),
        # seen from in front: the camera looks along the head's -z
        "R": torch.diag(torch.tensor([1.0, -1.0, -1.0])).repeat(frames, 1, 1),
        "t": torch.tensor([0.0, 0.0, 0.8]).repeat(frames, 1),
        "shape": torch.tensor([0.5, -0.3]),
    }
    values = values_of(rest)
    values[:, TURN] = 0.12 * wave[:, :3]
    values[:, SHIFT] = 0.004 * wave[:, 3:6]
    values[:, JAW.start] = 0.08 * (1.0 + wave[:, 6])
    values[:, EYES] = torch.stack((wave[:, 7], wave[:, 8], 0 * time, wave[:, 7], wave[:, 8], 0 * time), dim=1) * 0.15
    values[:, EYELIDS] = 0.5 + 0.5 * wave[:, 9:11]
    values[:, EXPRESSION] = wave[:, 11 : 11 + EXPRESSIONS]
    changed = torch.ones(values.shape[1], dtype=torch.bool)
    return moved_tracks(rest, values, changed, torch.zeros(3))


def drawn_clip(avatar: Avatar, frames: int = 10, train: int = 7) -> Clip:
    """The avatar's own pictures of `true_tracks`."""
    focal = 2.6 * SIZE
    tracks = true_tracks(frames)
    recording = Recording(
        name="drawn",
        fps=25.0,
        width=SIZE,
        height=SIZE,
        intrinsics=(focal, focal, SIZE / 2, SIZE / 2),
        names=tuple(f"{number:05d}" for number in range(1, frames + 1)),
        split=Split(tuple(range(train)), tuple(range(train, frames))),
        tracks=tracks,
        data_hash="0" * 64,
        head_fingerprint=avatar.head.assets.fingerprint,
    )
    with torch.no_grad():
        pictures = tuple(picture(avatar, recording, index) for index in range(frames))
    records = tuple(SimpleNamespace(tracking=number) for number in range(frames))
    return Clip(recording, pictures, SimpleNamespace(frames=records))


def picture(avatar: Avatar, recording: Recording, index: int) -> Frame:
    params, camera = recording.params(index), recording.camera(index)
    drawing = avatar.draw(avatar(params, None, camera.head_rotation), camera, BACKGROUND)
    head = (drawing.alpha > 1e-3).float()
    image = torch.lerp(BACKGROUND, drawing.image, head[..., None])
    ones, nothing = torch.ones_like(head), torch.zeros_like(head)
    return Frame(index, recording.names[index], camera, params, image, ones, head, nothing)


def wrongly_tracked(
    clip: Clip, seed: int = 0, degrees: float = 0.5, mm: float = 1.0, share: float = 0.1, common: bool = True
) -> Clip:
    """The same pictures with a tracking that errs by so much, root mean squares; frames before the last by turns.

    common   whether the head poses of the training frames err in the mean; what is trained on them would learn that
    """
    rng = np.random.default_rng(seed)
    values = values_of(clip.recording.tracks)
    errors = torch.from_numpy(rng.standard_normal(values.shape)).float()
    if not common:
        errors[:, POSE] -= errors[clip.recording.times(clip.recording.split.train), POSE].mean(dim=0)
    scale = share * values.std(dim=0)
    scale[TURN], scale[SHIFT] = math.radians(degrees) / math.sqrt(3), 1e-3 * mm / math.sqrt(3)
    scale[SHIFT.stop - 1] = 0.0  # depth hardly shows
    tracks = moved_tracks(clip.recording.tracks, values + errors * scale, scale > 0, torch.zeros(3))
    return replace(clip, recording=replace(clip.recording, tracks=tracks))


def screen_errors(avatar: Avatar, recording: Recording, truth: Recording, frames: Sequence[int]) -> float:
    """Root mean square distance of the vertices on the screen, pixels."""
    found = []
    for index in frames:
        places = [one.camera(index).project(avatar.head.vertices(one.params(index))) for one in (recording, truth)]
        found.append((places[0] - places[1])[:, :2].square().sum(dim=1).mean())
    return float(torch.stack(found).mean().sqrt())
