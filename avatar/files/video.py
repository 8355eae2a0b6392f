"""Videos, written as the pictures come and there whole or not at all: H.264; VP9 in WebM; ProRes where a MOV has alpha."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import cv2
import imageio_ffmpeg
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.errors import UserError
from avatar.files.atomic import temporary_name
from avatar.files.names import as_text
from avatar.tensors import to_8_bit

VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".webm")
ALPHA_SUFFIXES = (".mov", ".webm")
SHARP = 720  # rows of a picture that is shown large
CAPTION_SHARE = 0.08  # of the height of the pictures
MIN_CAPTION = 16  # pixels
INK, PAPER = (40, 40, 40), 245
BT709 = ("-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709")
"""Tagged: players take what is not for BT.601 or BT.709 by its size."""
ERROR_SCALE = 0.25  # mean absolute error at which the map is brightest


class Sound(NamedTuple):
    source: Path  # a file; one without sound is let pass
    start: float  # seconds into it, of what is taken
    length: float


@contextmanager
def video_writer(
    path: Path, fps: float, preset: str = "medium", sound: Sound | None = None, crf: int = 17
) -> Iterator[Callable[[UInt8[np.ndarray, "H W C"]], None]]:
    """A function that adds one frame to `path`: RGB (.mp4: H.264, yuv420p, plays everywhere), or RGBA with straight alpha
    (.mov: ProRes 4444, .webm: VP9).

    `preset` is the encoder's: "veryfast" takes two fifths of the usual one's time, for pictures that are only looked at.
    `crf` is H.264's: the larger, the smaller the file. An odd size gets one more row or column, a copy of the last. The
    file appears under its name when the block ends without an exception. Raises UserError for no frames, another size on
    the way, or an encoder that fails.
    """
    partial = temporary_name(path)
    shape: tuple[int, ...] | None = None
    encoder: subprocess.Popen[bytes] | None = None

    def add(frame: UInt8[np.ndarray, "H W C"]) -> None:
        nonlocal shape, encoder
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] not in (3, 4):
            raise ValueError(
                f"a video frame must be uint8 [H, W, 3] or [H, W, 4], got {frame.dtype} {list(frame.shape)}"
            )
        if shape is not None and frame.shape != shape:
            was, now = (f"{s[1]}x{s[0]}" for s in (shape, frame.shape))
            raise UserError(f"{path} cannot hold a frame of {now} pixels after frames of {was}")
        shape = frame.shape
        even = np.pad(frame, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)), mode="edge")
        with _failing_as_user_error(path):
            if encoder is None:
                encoder = _start_encoder(partial, even.shape, fps, ("-preset", preset, "-crf", f"{crf}"), sound)
            assert encoder.stdin is not None
            try:
                encoder.stdin.write(even.tobytes())
            except BrokenPipeError:
                _finish(encoder)

    with _failing_as_user_error(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield add
        if encoder is None:
            raise UserError(f"there is no frame to write to {path}")
        with _failing_as_user_error(path):
            _finish(encoder)
            with partial.open("rb") as file:
                os.fsync(file.fileno())
            partial.replace(path)
    finally:
        if encoder is not None:
            encoder.kill()
            encoder.communicate()
        with suppress(OSError):
            partial.unlink()


def _start_encoder(
    path: Path, shape: tuple[int, ...], fps: float, h264: Sequence[str], sound: Sound | None
) -> subprocess.Popen[bytes]:
    """ffmpeg, which takes RGB or RGBA bytes from its standard input. It is run here because imageio does not ask how it
    ended."""
    height, width, channels = shape
    layout = {3: "rgb24", 4: "rgba"}[channels]
    taken = ["-f", "rawvideo", "-pix_fmt", layout, "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    made = [*BT709, *_codec(path.suffix.lower(), channels == 4, h264)]
    if sound is None:
        heard = ["-an"]
    else:
        taken += ["-ss", f"{sound.start:.6f}", "-t", f"{sound.length:.6f}"]
        taken += ["-protocol_whitelist", "file", "-i", f"file:{sound.source}"]
        codec = "libopus" if path.suffix.lower() == ".webm" else "aac"
        heard = ["-map", "0:v", "-map", "1:a?", "-c:a", codec]
    # -xerror: it ends with its first error, so that what it says fits into the pipe. Damaged sound is no such error.
    options = ["-y", "-loglevel", "error", "-xerror"] if sound is None else ["-y", "-loglevel", "fatal"]
    out = f"file:{path}"  # a name may look like a protocol's
    return subprocess.Popen(
        [imageio_ffmpeg.get_ffmpeg_exe(), *options, *taken, *made, *heard, out],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C in the terminal is for the caller: it may want the file completed
    )


def _codec(suffix: str, has_alpha: bool, h264: Sequence[str]) -> list[str]:
    if suffix == ".webm":
        layout = "yuva420p" if has_alpha else "yuv420p"
        vp9 = "-c:v libvpx-vp9 -crf 20 -b:v 0 -cpu-used 4 -auto-alt-ref 0 -pix_fmt"
        return [*vp9.split(), layout]
    if has_alpha:
        return ["-c:v", "prores_ks", "-profile:v", "4444", "-pix_fmt", "yuva444p10le", "-alpha_bits", "8"]
    return ["-c:v", "libx264", *h264, "-pix_fmt", "yuv420p", "-movflags", "+faststart"]


def _finish(encoder: subprocess.Popen[bytes]) -> None:
    """Wait until the file is complete. Raises OSError with the encoder's words when it failed, however late."""
    _, said = encoder.communicate()
    if encoder.returncode != 0:
        first = said.decode(errors="replace").strip().partition("\n")[0]
        words = re.sub(r"^\[[^\]]*\] ", "", first)  # without the part of ffmpeg and its address
        number = 256 - encoder.returncode  # FFmpeg ends with -errno where it says nothing
        status = os.strerror(number) if 0 < number < 128 else f"the encoder ended with status {encoder.returncode}"
        raise OSError(words or status)


@contextmanager
def _failing_as_user_error(path: Path) -> Iterator[None]:
    """OSError comes from the disk and the encoder, RuntimeError from imageio-ffmpeg when there is no encoder."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise UserError(f"the video {path} cannot be written ({getattr(error, 'strerror', None) or error})") from error


def write_video(
    path: Path, frames: Iterable[UInt8[np.ndarray, "H W C"]], fps: float, sound: Sound | None = None
) -> None:
    """Encode `frames`, taken one at a time, as `video_writer` does."""
    with video_writer(path, fps, sound=sound) as add:
        for frame in frames:
            add(frame)


def side_by_side(
    images: Sequence[Float[Tensor, "_ _ 3"]], captions: Sequence[str], rows: int = 0
) -> UInt8[np.ndarray, "H_panel W_panel 3"]:
    """Pictures in [0, 1] from left to right, brought to the largest height, at least `rows`, each under its caption."""
    height = max(rows, *(image.shape[0] for image in images))
    strip = max(round(height * CAPTION_SHARE), MIN_CAPTION)
    columns = []
    for image, caption in zip(images, captions, strict=True):
        picture = to_8_bit(image).cpu().numpy()
        if picture.shape[0] != height:
            width = round(picture.shape[1] * height / picture.shape[0])
            picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_LANCZOS4)
        columns.append(np.concatenate((_caption(caption, strip, picture.shape[1]), picture)))
    return np.concatenate(columns, axis=1)


def fitted(picture: Float[Tensor, "h w 3"], height: int, width: int) -> Float[Tensor, "H W 3"]:
    """As large as a picture of this size holds it, over white: where the first camera lacks one, another's stands in."""
    h, w = picture.shape[:2]
    if (h, w) == (height, width):
        return picture
    scale = min(height / h, width / w)
    rows, columns = max(1, round(scale * h)), max(1, round(scale * w))
    top, left, sheet = (height - rows) // 2, (width - columns) // 2, torch.ones(height, width, 3)
    small = cv2.resize(picture.numpy(), (columns, rows), interpolation=cv2.INTER_AREA)
    sheet[top : top + rows, left : left + columns] = torch.from_numpy(small)
    return sheet


def padded(panel: UInt8[np.ndarray, "h w 3"], height: int, width: int) -> UInt8[np.ndarray, "H W 3"]:
    """With white below and at the right."""
    rows, columns = height - panel.shape[0], width - panel.shape[1]
    return np.pad(panel, ((0, rows), (0, columns), (0, 0)), constant_values=255)


def grid(pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]], columns: int) -> UInt8[np.ndarray, "H_grid W_grid 3"]:
    """Pictures row by row over white, each with the room of the largest."""
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    filled = [padded(picture, height, width) for picture in pictures]
    filled += [np.full_like(filled[0], 255)] * (-len(pictures) % columns)
    return np.concatenate([np.concatenate(filled[i : i + columns], axis=1) for i in range(0, len(filled), columns)])


def error_map(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Mean absolute error of the channels as a heat map: black at 0, light yellow from `ERROR_SCALE` up."""
    error = (image - target).abs().mean(dim=-1) / ERROR_SCALE
    levels = to_8_bit(error).cpu().numpy()
    colours = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return image.new_tensor(colours) / 255.0


def _caption(text: str, height: int, width: int) -> UInt8[np.ndarray, "H W 3"]:
    strip = np.full((height, width, 3), PAPER, np.uint8)
    text = as_text(text)  # half a surrogate pair in a file's name crashes OpenCV
    font, thickness = cv2.FONT_HERSHEY_SIMPLEX, 1
    (text_width, text_height), _ = cv2.getTextSize(text, font, 1.0, thickness)
    scale = min(0.5 * height / text_height, 0.92 * width / max(text_width, 1))
    origin = (round((width - text_width * scale) / 2), round((height + text_height * scale) / 2))
    cv2.putText(strip, text, origin, font, scale, INK, thickness, cv2.LINE_AA)
    return strip
