"""The data of INSTA and NeRFBlendShape as GaussianBlendshapes hands them out, written from the facts of that layout.

`checkpoint/%05d.frame` and `images/%05d.png` have the same numbers; there is no listing. INSTA's images are RGBA, with the
matte as alpha; NeRFBlendShape's are RGB, with `image_mask/mask_%05d.png` and the background `bc.jpg`.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from tracked_folder import SHAPE_COEFFICIENTS, frame_content, motion, render, write_head_model

from avatar.head.model import HeadModel

WIDTH, HEIGHT, FOCAL = 64, 56, 170.0
CENTRE = (30.5, 31.0)  # the principal point, off the middle of the picture


def write_blendshapes(folder: Path, frames: int = 24, *, image_mask: bool = False, first: int = 0) -> Path:
    """`image_mask` for NeRFBlendShape's data, else INSTA's. The head model is FOLDER/head_model."""
    assets = write_head_model(folder / "head_model")
    identity = np.zeros(SHAPE_COEFFICIENTS, np.float32)
    identity[:2] = 0.5, -0.3
    head = HeadModel(assets, torch.from_numpy(identity))
    for name in ("images", "checkpoint", *(("image_mask",) if image_mask else ())):
        (folder / name).mkdir()
    for number, track in enumerate(motion(frames, assets.num_expressions, 3), start=first):
        content = frame_content(track, identity, WIDTH, HEIGHT, number)
        K = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]], np.float32)
        content["opencv"]["K"] = K[None]  # type: ignore[index]
        torch.save(content, folder / "checkpoint" / f"{number:05d}.frame")
        image, mask, _ = render(head, content, WIDTH, HEIGHT)
        picture = image[..., ::-1] if image_mask else np.dstack((image[..., ::-1], mask * 255))
        assert cv2.imwrite(str(folder / "images" / f"{number:05d}.png"), picture)
        if image_mask:
            assert cv2.imwrite(str(folder / "image_mask" / f"mask_{number:05d}.png"), mask * 255)
    (folder / "canonical.obj").write_text("v 0 0 0\n")
    if image_mask:
        assert cv2.imwrite(str(folder / "bc.jpg"), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    return folder


def renumber(folder: Path, kind: str, by: int) -> None:
    """Add `by` to the numbers of the files in FOLDER/KIND."""
    for path in sorted((folder / kind).iterdir(), reverse=by > 0):
        path.rename(path.with_name(f"{path.stem[:-5]}{int(path.stem[-5:]) + by:05d}{path.suffix}"))
