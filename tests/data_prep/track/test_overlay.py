"""The overlay that `avatar track` writes."""

from __future__ import annotations

from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import torch

from avatar.data.read_image import read_image
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.formats.metrical_tracker import read_tracking
from data_prep.progress import silent
from data_prep.track.overlay import FrameParts, write_overlay


def test_the_overlay_is_sharp_where_the_frames_are_small(tracked_folder: Path, tmp_path: Path) -> None:
    tracks = read_tracking({n: tracked_folder / "checkpoint" / f"{n:05d}.frame" for n in range(5)}).frames
    image = read_image(tracked_folder / "imgs" / "00001.jpg")
    assert image.shape[0] < 720
    parts = FrameParts(image, *np.full((2, *image.shape[:2]), 255, np.uint8))
    head = HeadModel(load_head_assets(tracked_folder / "head_model"), torch.from_numpy(tracks[0].shape).float())
    write_overlay(tmp_path, head, tracks, lambda _: parts, 25.0, silent)
    video = iio.imread(tmp_path / "overlay.mp4")
    assert video.shape == (5, 720, 720, 3)
    plain = cv2.resize(image, (720, 720), interpolation=cv2.INTER_CUBIC)
    assert 1 < np.abs(video[0].astype(float) - plain).mean() < 40, "the picture with lines over it"
    sheet = cv2.imread(str(tmp_path / "overlay.jpg"))
    assert sheet is not None and sheet.shape[:2] == (2 * 720, 4 * 720)
