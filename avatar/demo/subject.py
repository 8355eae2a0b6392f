"""Make a whole tracked subject: rendered frames, masks, tracking and head model in the FlashAvatar folder layout."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from tqdm import tqdm

from avatar.compute.processors import processor_count
from avatar.compute.workers import in_order
from avatar.demo.head import NUM_EXPRESSION, NUM_IDENTITY, demo_head
from avatar.demo.head_files import write_head_model
from avatar.demo.identity import sample_identity
from avatar.demo.performance import MOTIONS, Motion, Performance, frame_camera, frame_params, perform
from avatar.demo.render import RenderedFrame, Renderer
from avatar.errors import UserError
from avatar.files.atomic import check_target, whole_folder
from avatar.files.write_image import write_image
from avatar.types import Camera, HeadParams

MAX_FRAMES, MIN_SIZE, MAX_SIZE = 100_000, 64, 1024
JPEG_QUALITY = 96


def make_subject(
    out: Path,
    frames: int = 600,
    size: int = 256,
    seed: int = 0,
    motion: Motion = "speech",
    neutral_bias: float = 0.0,
) -> Path:
    """Render `frames` pictures of `size` x `size` pixels of the person of `seed`, and write them with their tracking.

    The folder appears under its name only when it is complete. Same arguments, same files. `neutral_bias` is how much of
    the shape the tracking explains by the expression (`tracking_bias`); the pictures do not depend on it. Returns `out`.
    Raises UserError for values out of range and for a folder that is not empty.
    """
    out = Path(out)
    check_arguments(frames, size, seed, motion)
    if not 0.0 <= neutral_bias <= 1.0:
        raise UserError(f"neutral_bias must be from 0 to 1, not {neutral_bias}")
    check_target(out)
    with whole_folder(out) as folder:
        _write_subject(folder, frames, size, seed, motion, neutral_bias)
    return out


def make_head_model(out: Path) -> Path:
    """Write the demo people's head model, which is the same for all of them, as the folder `out`, whole or not at all.

    Returns `out`. Raises UserError for a folder that is not empty.
    """
    out = Path(out)
    check_target(out)
    with whole_folder(out) as folder:
        write_head_model(folder, demo_head())
    return out


class TrackingBias(NamedTuple):
    """What a tracker adds to a person's true coefficients, in every frame alike."""

    expression: torch.Tensor  # float32 [100]
    shape: np.ndarray  # float32 [300]


def tracking_bias(seed: int, strength: float) -> TrackingBias:
    """The person's own neutral as tracked: expression coefficients away from zero, and the shape that makes up for them.

    The shape's change undoes the displacement of the expression's as well as the identity basis can (least squares): a
    tracker sees the sum of both and cannot tell them apart. `strength` is the standard deviation of the coefficients.
    """
    head = demo_head()
    E, S = head.expression_dirs.shape[2], head.identity_dirs.shape[2]
    offset = strength * np.random.default_rng((seed, 3)).standard_normal(E)
    displaced = head.expression_dirs.reshape(-1, E) @ offset
    undo = -np.linalg.lstsq(head.identity_dirs.reshape(-1, S), displaced, rcond=None)[0]
    expression, shape = np.zeros(NUM_EXPRESSION, np.float32), np.zeros(NUM_IDENTITY, np.float32)
    expression[:E], shape[:S] = offset, undo
    return TrackingBias(torch.from_numpy(expression), shape)


def check_arguments(frames: int, size: int, seed: int, motion: str) -> None:
    """Raises UserError for values out of range."""
    check_number("frames", frames, 1)
    check_number("size", size, MIN_SIZE, MAX_SIZE)
    check_number("seed", seed, 0, 2**32 - 1)
    if motion not in MOTIONS:
        raise UserError(f"motion must be one of {', '.join(MOTIONS)}, not {motion!r}")


def check_number(name: str, value: int, low: int, high: int = MAX_FRAMES) -> None:
    """Raises UserError for what is no whole number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise UserError(f"{name} must be a whole number, not {value!r}")
    if not low <= value <= high:
        raise UserError(f"{name} must be from {low} to {high}, not {value}")


def _write_subject(folder: Path, frames: int, size: int, seed: int, motion: Motion, neutral_bias: float) -> None:
    for name in ("imgs", "alpha", "parsing", "checkpoint"):
        (folder / name).mkdir()
    identity = sample_identity(seed)
    renderer = Renderer(identity)
    write_head_model(folder / "head_model", renderer.performer.head)
    performance = perform(seed, frames, motion)
    bias = tracking_bias(seed, neutral_bias)
    with single_threads():
        done = tqdm(rendered(renderer, performance, size), total=frames, desc="rendering", unit="frame")
        for index, (params, camera, picture) in enumerate(done):
            tracked = replace(params, expression=params.expression + bias.expression)
            _write_frame(folder, index, tracked, camera, picture, identity.shape + bias.shape)


@contextmanager
def single_threads() -> Iterator[None]:
    """One thread a frame is the better use of the cores than many in one frame's short operations."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def rendered(
    renderer: Renderer, performance: Performance, size: int
) -> Iterator[tuple[HeadParams, Camera, RenderedFrame]]:
    """Frames in order, rendered a few ahead, by as many threads as there are cores."""

    def one(frame: int) -> tuple[HeadParams, Camera, RenderedFrame]:
        params, camera = frame_params(performance, frame), frame_camera(performance, frame, size)
        return params, camera, renderer.render(params, camera)

    return in_order(one, range(len(performance.jaw)), processor_count())


def _write_frame(
    folder: Path, index: int, params: HeadParams, camera: Camera, picture: RenderedFrame, shape: np.ndarray
) -> None:
    """Image and masks are numbered from 1, the tracking from 0, as video extraction and metrical-tracker leave them."""
    stem = f"{index + 1:05d}"
    write_image(folder / "imgs" / f"{stem}.jpg", picture.image, JPEG_QUALITY)
    write_image(folder / "alpha" / f"{stem}.jpg", picture.alpha, JPEG_QUALITY)
    for name, mask in (("neckhead", picture.head), ("mouth", picture.mouth)):
        write_image(folder / "parsing" / f"{stem}_{name}.png", np.where(mask > 127, np.uint8(255), np.uint8(0)))
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]], np.float32)
    tracked = {
        "flame": {
            "exp": params.expression.numpy()[None],
            "shape": shape[None],
            "tex": np.zeros((1, 140), np.float32),
            "sh": np.zeros((1, 9, 3), np.float32),
            "eyes": params.eyes.numpy()[None],
            "eyelids": params.eyelids.numpy()[None],
            "jaw": params.jaw.numpy()[None],
        },
        "opencv": {"R": camera.R_cam_world.numpy()[None], "t": camera.t_cam_world.numpy()[None], "K": K[None]},
        "img_size": np.array([camera.width, camera.height]),
        "frame_id": f"{index:05d}",
        "global_step": 0,
    }
    torch.save(tracked, folder / "checkpoint" / f"{index:05d}.frame")
