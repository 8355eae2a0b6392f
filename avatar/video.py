"""Videos of side-by-side pictures: H.264 in MP4, written as the pictures come and there whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import imageio.v2 as imageio
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.errors import UserError

CAPTION_SHARE = 0.08  # of the height of the pictures
MIN_CAPTION = 16  # pixels
INK, PAPER = (40, 40, 40), 245


@contextmanager
def video_writer(path: Path, fps: float) -> Iterator[Callable[[UInt8[np.ndarray, "H W 3"]], None]]:
    """A function that adds one RGB frame to `path` (.mp4: H.264, yuv420p, plays everywhere).

    An odd size gets one more row or column, a copy of the last. The file appears under its name when the block ends
    without an exception. Raises UserError for no frames, another size on the way, or an encoder that fails.
    """
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    shape: tuple[int, ...] | None = None

    def add(frame: UInt8[np.ndarray, "H W 3"]) -> None:
        nonlocal shape
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise ValueError(f"a video frame must be uint8 [H, W, 3], got {frame.dtype} {list(frame.shape)}")
        if shape is not None and frame.shape != shape:
            was, now = (f"{s[1]}x{s[0]}" for s in (shape, frame.shape))
            raise UserError(f"{path} cannot hold a frame of {now} pixels after frames of {was}")
        shape = frame.shape
        odd = ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0))
        with _failing_as_user_error(path):
            encoder.append_data(np.pad(frame, odd, mode="edge"))

    with _failing_as_user_error(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        encoder = imageio.get_writer(
            partial,
            format="FFMPEG",  # type: ignore[arg-type]
            mode="I",
            fps=fps,
            codec="libx264",
            pixelformat="yuv420p",
            quality=None,
            macro_block_size=1,
            ffmpeg_log_level="error",
            output_params=["-crf", "17", "-movflags", "+faststart"],
        )
    try:
        yield add
        if shape is None:
            raise UserError(f"there is no frame to write to {path}")
        with _failing_as_user_error(path):
            encoder.close()
            partial.replace(path)
    finally:
        encoder.close()
        partial.unlink(missing_ok=True)


@contextmanager
def _failing_as_user_error(path: Path) -> Iterator[None]:
    """imageio raises OSError when the encoder ends early and RuntimeError when there is none."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise UserError(f"the video {path} cannot be written ({reason})") from error


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], fps: float) -> None:
    """Encode `frames`, taken one at a time, as `video_writer` does."""
    with video_writer(path, fps) as add:
        for frame in frames:
            add(frame)


def side_by_side(
    images: Sequence[Float[Tensor, "H W 3"]], captions: Sequence[str]
) -> UInt8[np.ndarray, "H_panel W_panel 3"]:
    """Pictures in [0, 1] from left to right, brought to the largest height, each under its caption."""
    height = max(image.shape[0] for image in images)
    strip = max(round(height * CAPTION_SHARE), MIN_CAPTION)
    columns = []
    for image, caption in zip(images, captions, strict=True):
        picture = (image.detach().cpu().clamp(0.0, 1.0) * 255.0).round().byte().numpy()
        if picture.shape[0] != height:
            width = round(picture.shape[1] * height / picture.shape[0])
            picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC)
        columns.append(np.concatenate((_caption(caption, strip, picture.shape[1]), picture)))
    return np.concatenate(columns, axis=1)


def error_map(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], full_scale: float
) -> Float[Tensor, "H W 3"]:
    """Mean absolute error of the channels as a heat map: black at 0, light yellow from `full_scale` up."""
    error = (image - target).abs().mean(dim=-1) / full_scale
    levels = (error.detach().cpu().clamp(0.0, 1.0) * 255.0).round().byte().numpy()
    colours = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return image.new_tensor(colours) / 255.0


def _caption(text: str, height: int, width: int) -> UInt8[np.ndarray, "H W 3"]:
    strip = np.full((height, width, 3), PAPER, np.uint8)
    font, thickness = cv2.FONT_HERSHEY_SIMPLEX, 1
    (text_width, text_height), _ = cv2.getTextSize(text, font, 1.0, thickness)
    scale = min(0.5 * height / text_height, 0.92 * width / max(text_width, 1))
    origin = (round((width - text_width * scale) / 2), round((height + text_height * scale) / 2))
    cv2.putText(strip, text, origin, font, scale, INK, thickness, cv2.LINE_AA)
    return strip
