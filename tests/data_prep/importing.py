"""A folder in any format, imported, and compared with the small tracked folder that it was made from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from avatar.head.rasterize import rasterize_mesh
from data_prep.prepare.prepare import prepare

FRAMES, SIZE, HEIGHT = 24, 64, 56
PIXELS = 1e-3  # of the projected vertices; the parameters are float32


def import_folder(
    folder: Path, tracked: Path, out: Path, test_frames: int | None = None, **options: Any
) -> tuple[Subject, list[str]]:
    said: list[str] = []
    head = load_head_assets(tracked / "head_model")
    prepared = prepare(
        Source(folder, tracked / "head_model", **options), head, out=out, test_frames=test_frames, say=said.append
    )
    return Subject.open(prepared), said


def assert_same_pictures(subject: Subject, original: Subject, tracked: Path) -> None:
    assets = load_head_assets(tracked / "head_model")
    assert len(subject) == len(original)
    heads = [HeadModel(assets, s.identity) for s in (subject, original)]
    for index in range(len(subject)):
        frames = subject.frame(index), original.frame(index)
        mine, theirs = (
            frame.camera.project(head.vertices(frame.params)) for head, frame in zip(heads, frames, strict=True)
        )
        torch.testing.assert_close(mine[:, :2], theirs[:, :2], atol=PIXELS, rtol=0)
        torch.testing.assert_close(mine[:, 2], theirs[:, 2], atol=1e-5, rtol=0)
        ids = [rasterize_mesh(v.numpy(), assets.faces.numpy(), HEIGHT, SIZE).face_id for v in (mine, theirs)]
        assert np.mean(ids[0] == ids[1]) > 0.998
        assert torch.equal(frames[0].image, frames[1].image)
