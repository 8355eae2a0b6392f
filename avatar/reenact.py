"""Driving one person's avatar with another person's motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from tqdm import tqdm

from avatar.data.loader import FrameLoader
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.model import HeadModel
from avatar.render import Renderer
from avatar.run import Run
from avatar.transfer import Transfer, transfer_motion
from avatar.types import Camera, HeadParams
from avatar.video import side_by_side, write_video

FOCAL_TOLERANCE = 0.1  # relative difference of the field of view from which a warning is worth its line


def reenact(
    run: Run,
    driver: Subject,
    *,
    transfer: Transfer = "relative",
    camera: Literal["driver", "target"] = "driver",
    out: Path | None = None,
    say: Callable[[str], None] = print,
) -> Path:
    """Render the avatar with the driver's motion, as many frames as the driver has, beside the driver's own picture.

    camera    "driver": the head pose of each driver frame; "target": the avatar's own camera at rest, held still.
    Returns the video's path. Raises UserError when the driver was tracked with another head model.
    """
    if driver.head_fingerprint != run.subject.head_fingerprint:
        raise UserError(
            f"the driver {driver.name} was tracked with another head model than the avatar {run.subject.name} "
            f"({driver.head_fingerprint[:12]} and {run.subject.head_fingerprint[:12]}): the same coefficients mean "
            "other expressions there; track the driver again with the avatar's head model"
        )
    out = out or run.path / "reenact" / f"{driver.name}-{transfer}.mp4"
    target_frames = run.subject.split.train
    moved, source, goal = transfer_motion(
        [driver.params(i) for i in range(len(driver))],
        [run.subject.params(i) for i in target_frames],
        transfer,
        HeadModel(run.avatar.head.assets, driver.identity),
        run.avatar.head,
    )
    if source is not None and goal is not None and source.frame is not None and goal.frame is not None:
        theirs = driver.manifest.frames[source.frame].name
        own_name = run.subject.manifest.frames[target_frames[goal.frame]].name
        say(f"Neutral expression: frame {theirs} of {driver.name}, frame {own_name} of {run.subject.name}")

    size = run.config.data.size
    own = run.subject.camera(target_frames[goal.frame if goal and goal.frame is not None else 0], size)
    warn_of_other_intrinsics(driver.camera(0, size), own, say)
    cameras = [driver.camera(i, size) if camera == "driver" else own for i in range(len(driver))]
    with FrameLoader(driver, size, run.config.data.cache_mb << 20, run.config.data.workers) as loader:
        write_video(out, pairs(run, loader, moved, cameras), driver.fps)
    say(f"{len(driver)} frames written to {out}")
    return out


def pairs(run: Run, loader: FrameLoader, motion: list[HeadParams], cameras: list[Camera]) -> Iterator[np.ndarray]:
    """The driver's picture beside the avatar's render, frame by frame, uint8."""
    renders = Renderer(run.avatar, torch.tensor(run.config.data.background)).stream(zip(motion, cameras, strict=True))
    frames = tqdm(
        loader.frames(range(len(motion))), total=len(motion), desc="reenact", unit="frame", dynamic_ncols=True
    )
    for frame, render in zip(frames, renders, strict=True):
        yield side_by_side([frame.image, render.image], ["driver", run.subject.name])


def warn_of_other_intrinsics(driver: Camera, target: Camera, say: Callable[[str], None]) -> None:
    """Say when the two videos were taken through lenses that differ: the perspective of the face is then another."""
    fields = [2 * np.degrees(np.arctan(c.height / (2 * c.fy))) for c in (driver, target)]
    if abs(driver.fy / driver.height - target.fy / target.height) > FOCAL_TOLERANCE * target.fy / target.height:
        say(
            f"Warning: the driver's camera sees {fields[0]:.1f} degrees, the avatar's {fields[1]:.1f}: shown from the "
            "driver's camera the head has another perspective than in training; --camera target keeps its own"
        )
