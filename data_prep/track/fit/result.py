"""What is fitted to, and what comes of it: one `FrameTrack` for each frame with a face."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.files.pickles import load_npz, save_npz
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.projection import project_head
from data_prep.track.faces.landmarks import Landmarks

_FIELDS = ("R", "t", "jaw", "eyes", "eyelids", "neck", "expression")


@dataclass(frozen=True)
class Clip:
    """What is fitted to."""

    landmarks: Landmarks  # in pixels of the frames
    intrinsics: tuple[float, float, float, float]
    images: Callable[[int], np.ndarray]  # by a frame's number: uint8 [H, W, 3]
    mattes: Callable[[int], np.ndarray]  # uint8 [H, W]


@dataclass(frozen=True)
class Fit:
    """The tracks by frame number, and what the fit says of itself."""

    tracks: dict[int, FrameTrack]
    figures: dict[str, Any]
    key: str = ""  # of the stage that made it

    def save(self, path: Path) -> None:
        arrays = {name: np.stack([getattr(track, name) for track in self.tracks.values()]) for name in _FIELDS}
        arrays |= {"number": np.array(list(self.tracks)), "shape": next(iter(self.tracks.values())).shape}
        save_npz(path, arrays)

    @classmethod
    def load(
        cls, path: Path, intrinsics: Sequence[float], size: tuple[int, int], figures: dict[str, Any], key: str
    ) -> Fit:
        arrays = load_npz(path)
        camera = np.array(intrinsics)
        tracks = {
            number: FrameTrack(
                **{name: arrays[name][row] for name in _FIELDS}, shape=arrays["shape"], intrinsics=camera, size=size
            )
            for row, number in enumerate(arrays["number"].tolist())
        }
        return cls(tracks, figures, key)

    def model(self, head: HeadAssets) -> HeadModel:
        return HeadModel(head, torch.from_numpy(next(iter(self.tracks.values())).shape).float())

    def projector(self, head: HeadAssets) -> Callable[[int], np.ndarray]:
        """A function from a frame's number to the posed vertices [V, 3]: x, y in pixels, depth."""
        model = self.model(head)

        def project(number: int) -> np.ndarray:
            track = self.tracks[number]
            return project_head(model, track, track.intrinsics, *track.size)

        return project
