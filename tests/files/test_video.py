"""Videos: what is read back is what was written, whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch

from avatar.errors import UserError
from avatar.files.video import ERROR_SCALE, error_map, side_by_side, write_video
from data_prep.track.footage.source import Span, whole
from data_prep.track.footage.video import open_video


def gradients(count: int, height: int, width: int) -> Iterator[np.ndarray]:
    for index in range(count):
        y, x = np.mgrid[0:height, 0:width]
        yield np.stack((255 * x / width, 255 * y / height, np.full_like(x, 20 * index)), axis=-1).astype(np.uint8)


@pytest.mark.parametrize(("height", "width"), [(48, 64), (33, 51)])
def test_reads_back_in_order_size_and_rate(tmp_path: Path, height: int, width: int) -> None:
    path = tmp_path / "new" / "clip.mp4"
    write_video(path, gradients(7, height, width), fps=12.5)
    reader = imageio.get_reader(path)
    meta = reader.get_meta_data()
    assert meta["codec"] == "h264" and meta["pix_fmt"].startswith("yuv420p") and meta["fps"] == 12.5
    assert meta["size"] == (width + width % 2, height + height % 2)
    frames = [np.asarray(frame) for frame in reader]
    assert len(frames) == 7
    for frame, truth in zip(frames, gradients(7, height, width), strict=True):
        error = np.abs(frame[:height, :width].astype(int) - truth)
        assert error.mean() < 3.0  # of 255: chroma is stored at half the resolution
    assert [p.name for p in path.parent.iterdir()] == ["clip.mp4"]


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_a_video_says_by_which_matrix_its_colours_are_made(tmp_path: Path, suffix: str) -> None:
    """Players take a video without a tag for BT.601 or BT.709 by its size."""
    write_video(tmp_path / f"a{suffix}", [np.full((64, 80, 3), (40, 60, 220), np.uint8)] * 2, fps=25)
    video = open_video(tmp_path / f"a{suffix}")
    assert video.colour[1] == "bt709"
    picture = next(video.read(whole(80, 64), Span(), str))
    assert np.abs(picture.image.astype(int) - (40, 60, 220)).max() <= 2


def test_a_failure_on_the_way_leaves_the_old_file_and_no_part(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"the old one")

    def failing() -> Iterator[np.ndarray]:
        yield from gradients(3, 32, 32)
        raise UserError("frame 00004.jpg is damaged")

    with pytest.raises(UserError, match=r"frame 00004\.jpg is damaged"):
        write_video(path, failing(), fps=25)
    assert path.read_bytes() == b"the old one"
    assert [p.name for p in tmp_path.iterdir()] == ["clip.mp4"]


@pytest.mark.usefixtures("any_shapes")
def test_refusals(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    with pytest.raises(UserError, match=r"there is no frame to write to .*clip\.mp4"):
        write_video(path, iter(()), fps=25)
    with pytest.raises(UserError, match=r"clip\.mp4 cannot hold a frame of 40x32 pixels after frames of 32x32"):
        write_video(path, [*gradients(1, 32, 32), *gradients(1, 32, 40)], fps=25)
    with pytest.raises(ValueError, match=r"must be uint8 \[H, W, 3\] or \[H, W, 4\], got float64 \[32, 32, 3\]"):
        write_video(path, [np.zeros((32, 32, 3))], fps=25)
    assert list(tmp_path.iterdir()) == []


def test_an_encoder_that_fails_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "clip.mp4"
    broken = tmp_path / "ffmpeg"
    broken.write_text('#!/bin/sh\nif [ "$1" = -version ]; then echo ffmpeg version 7; exit 0; fi\nexit 1\n')
    broken.chmod(0o755)
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: str(broken))
    with pytest.raises(UserError, match=r"the video .*clip\.mp4 cannot be written \("):
        write_video(path, gradients(200, 64, 64), fps=25)
    assert not path.exists()


def test_an_encoder_that_ends_with_an_error_number_says_what_it_means(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "ffmpeg"
    tells = 'if [ "$1" = -version ]; then echo ffmpeg version 7; exit 0; fi'
    broken.write_text(f"#!/bin/sh\n{tells}\ncat > /dev/null\nexit 228\n")
    broken.chmod(0o755)
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: str(broken))
    with pytest.raises(UserError, match="cannot be written .No space left on device"):
        write_video(tmp_path / "clip.mp4", gradients(3, 64, 64), fps=25)


def test_a_name_may_look_like_a_protocols(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_video(Path("take:1.mp4"), gradients(3, 64, 64), fps=25)
    assert [path.name for path in tmp_path.iterdir()] == ["take:1.mp4"]


def test_a_folder_that_cannot_be_made_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(UserError, match=r"the video .*clip\.mp4 cannot be written \(.*(Not a directory|File exists)"):
        write_video(tmp_path / "file" / "clip.mp4", gradients(1, 32, 32), fps=25)


def test_errors_of_the_caller_are_not_blamed_on_the_video(tmp_path: Path) -> None:
    def failing() -> Iterator[np.ndarray]:
        yield from gradients(1, 32, 32)
        raise RuntimeError("the renderer broke")

    with pytest.raises(RuntimeError, match="the renderer broke"):
        write_video(tmp_path / "clip.mp4", failing(), fps=25)


def test_pictures_stand_side_by_side_under_captions() -> None:
    red, green = torch.zeros(2, 60, 80, 3)
    red[..., 0], green[..., 1] = 1.0, 1.5
    small = torch.full((30, 20, 3), 0.25)
    panel = side_by_side((red, green, small), ("truth", "render", "a caption far too long for its picture"))
    strip = panel.shape[0] - 60
    assert panel.dtype == np.uint8 and panel.shape == (60 + strip, 80 + 80 + 40, 3) and strip >= 16
    assert (panel[strip:, :80] == (255, 0, 0)).all()
    assert (panel[strip:, 80:160] == (0, 255, 0)).all()  # clamped
    assert (panel[strip:, 160:] == 64).all()
    for left, right in ((0, 80), (80, 160), (160, 200)):
        ink = panel[:strip, left:right].min(axis=(0, 2)) < 128
        assert ink.any() and not ink[0] and not ink[-1]  # every caption is there and inside its column


def test_a_caption_may_be_a_files_name_that_is_not_unicode() -> None:
    picture = torch.zeros(40, 200, 3)
    first, second = (side_by_side([picture], [caption]) for caption in ("caf\udce9_00001", "caf\\udce9_00001"))
    assert np.array_equal(first, second)


def test_small_pictures_stand_side_by_side_enlarged() -> None:
    image = torch.zeros(50, 40, 3)
    image[:, 20:] = 1.0
    panel = side_by_side((image, image), ("truth", "render"), 150)
    strip = panel.shape[0] - 150
    assert panel.shape[1] == 2 * 120 and strip >= 16
    assert panel[strip:, :50].max() < 30 and panel[strip:, 70:110].min() > 225
    assert side_by_side((image,), ("truth",), 50).shape == side_by_side((image,), ("truth",)).shape == (66, 40, 3)


def test_error_map_grows_with_the_error() -> None:
    target = torch.full((4, 5, 3), 0.5)
    image = target.clone()
    image[0, 0] += 0.05
    image[0, 1] += 0.1
    image[0, 2] -= 0.4
    image[0, 3] -= ERROR_SCALE
    heat = error_map(image, target)
    light = heat.sum(dim=-1)
    assert light[1:].max() < 0.05  # no error: black
    assert light[1, 0] < light[0, 0] < light[0, 1] < light[0, 2]
    assert torch.equal(heat[0, 2], heat[0, 3])  # full scale and above
