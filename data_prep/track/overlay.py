"""The tracked mesh over the frames, as a video and as a sheet of some of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from avatar.data.split import evenly_spread
from avatar.files.video import SHARP, grid, video_writer
from avatar.files.write_image import write_image
from avatar.head.model import HeadModel
from data_prep.check.overlay import MASK, MOUTH, draw_mesh, outline
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.mask_overlap import MeshProjector
from data_prep.progress import Progress
from data_prep.track.frames import ahead

OVERLAY_VIDEO, OVERLAY_SHEET = "overlay.mp4", "overlay.jpg"
_SHOWN, _COLUMNS = 12, 4  # pictures in the sheet


class FrameParts(NamedTuple):
    image: np.ndarray  # uint8 [H, W, 3]
    head: np.ndarray  # uint8 [H, W]
    mouth: np.ndarray


def write_overlay(
    folder: Path,
    head: HeadModel,
    tracks: dict[int, FrameTrack],
    read: Callable[[int], FrameParts],
    fps: float,
    progress: Progress,
) -> None:
    """FOLDER/overlay.mp4 of all frames, and FOLDER/overlay.jpg of some that are spread over the clip."""
    first = next(iter(tracks.values()))
    project = MeshProjector(head)
    width, height = round(first.size[0] * SHARP / first.size[1]), SHARP
    resampling = cv2.INTER_AREA if first.size[1] > height else cv2.INTER_CUBIC
    numbers = list(tracks)
    shown = set(evenly_spread(numbers, _SHOWN))
    pictures: list[np.ndarray] = []

    def draw(number: int) -> np.ndarray:
        parts = read(number)
        canvas = cv2.resize(parts.image, (width, height), interpolation=resampling)
        canvas = draw_mesh(canvas, project(tracks[number], width, height))
        for colour, mask in ((MASK, parts.head), (MOUTH, parts.mouth)):
            outline(canvas, cv2.resize(mask, (width, height), interpolation=cv2.INTER_LINEAR) > 127, colour)
        return canvas

    with video_writer(folder / OVERLAY_VIDEO, fps, preset="veryfast", crf=20) as add:
        for number, canvas in ahead(numbers, draw, progress, "drawing the overlay"):
            add(canvas)
            if number in shown:
                pictures.append(canvas)
    write_image(folder / OVERLAY_SHEET, grid(pictures, min(_COLUMNS, len(pictures))))
