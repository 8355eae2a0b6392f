"""Videos for tests, made with the bundled ffmpeg: of drawn pictures, or of the demo's person."""

from __future__ import annotations

import functools
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.render import render_frame

X264 = ("-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p")
LOSSLESS = ("-c:v", "libx264rgb", "-qp", "0")


def ffmpeg(*arguments: str | Path, stdin: bytes | None = None) -> None:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-loglevel", "error", "-y", *map(str, arguments)]
    done = subprocess.run(command, input=stdin, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode(errors="replace")


def encode(
    path: Path,
    pictures: Iterable[np.ndarray],
    fps: float | str = 25,
    options: Sequence[str] = X264,
    before: Sequence[str] = (),
) -> Path:
    """A video of uint8 pictures [H, W, 3 or 4]; `before` are options of the input."""
    frames = [np.ascontiguousarray(picture) for picture in pictures]
    height, width, channels = frames[0].shape
    raw = b"".join(frame.tobytes() for frame in frames)
    pixels = {3: "rgb24", 4: "rgba"}[channels]
    taken = ("-f", "rawvideo", "-pix_fmt", pixels, "-s", f"{width}x{height}", "-r", f"{fps}", *before, "-i", "-")
    ffmpeg(*taken, *options, path, stdin=raw)
    return path


def spot(x: float, y: float, width: int, height: int, sigma: float = 6.0) -> np.ndarray:
    """A coloured blob on grey, centred at a point (pixel centres at +0.5)."""
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    glow = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))[..., None]
    return (30 + glow * np.array([200, 80, 40])).round().astype(np.uint8)


def centre_of(image: np.ndarray) -> tuple[float, float]:
    """Where the blob of `spot` is, by its red part."""
    weight = np.clip(image[..., 0].astype(float) - 36, 0, None)
    rows, columns = np.mgrid[0 : image.shape[0], 0 : image.shape[1]] + 0.5
    return float((columns * weight).sum() / weight.sum()), float((rows * weight).sum() / weight.sum())


@functools.cache
def talking(frames: int, size: int, seed: int = 1) -> tuple[np.ndarray, ...]:
    """Pictures of the demo's person."""
    performance = perform(seed, frames, "speech")
    return tuple(
        render_frame(seed, frame_params(performance, n), frame_camera(performance, n, size)).image
        for n in range(frames)
    )
