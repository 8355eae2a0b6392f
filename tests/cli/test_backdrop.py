"""`--background` of `avatar reenact` and `avatar export`, and the driver's sound."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from command_line import avatar
from heads import rest_params
from lively import lively_run

from avatar.files.video import Sound, write_video
from avatar.motion.drive import Drive
from avatar.pipeline.backdrop import _covering, parse_backdrop
from avatar.pipeline.reenact import drive_sound
from avatar.runs.trained_avatar import load_avatar

FFMPEG = imageio_ffmpeg.get_ffmpeg_exe()


@pytest.fixture(scope="module")
def run(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lively_run(tracked_folder, tmp_path_factory.mktemp("runs") / "run", "model.uv_size=16")


@pytest.fixture(scope="module")
def drive(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("drive") / "drive.npz"
    avatar("drive-file", tracked_folder, "--out", file)
    return file


def decoded(video: Path, layout: str, *options: str) -> np.ndarray:
    """The first frame's bytes."""
    words = [
        FFMPEG,
        "-loglevel",
        "error",
        *options,
        "-i",
        str(video),
        "-frames:v",
        "1",
        "-f",
        "rawvideo",
        "-pix_fmt",
        layout,
        "-",
    ]
    done = subprocess.run(words, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, len(layout))


def test_what_lies_behind(run: Path, tracked_folder: Path, tmp_path: Path) -> None:
    trained = load_avatar(run, tracked_folder / "head_model")
    rendering = trained.render(trained.rest_params())
    alpha = rendering.alpha[..., None]
    red = torch.from_numpy(parse_backdrop("red").pixels(rendering, trained.background)) / 255
    expected = rendering.image + (1 - alpha) * (torch.tensor([1.0, 0.0, 0.0]) - trained.background)
    assert (red - expected.clamp(0, 1)).abs().max() < 0.003
    straight = torch.from_numpy(parse_backdrop("transparent").pixels(rendering, trained.background)) / 255
    back = straight[..., :3] * straight[..., 3:] + (1 - straight[..., 3:]) * trained.background
    assert (back - rendering.image.clamp(0, 1)).abs().max() < 0.02
    picture = np.zeros((40, 400, 3), np.uint8)
    picture[:, 150:250] = (10, 200, 30)  # blue, green, red
    cv2.imwrite(str(tmp_path / "wide.png"), picture)
    over = parse_backdrop(str(tmp_path / "wide.png")).pixels(rendering, trained.background)
    assert over.shape == (*rendering.alpha.shape, 3)
    corner, middle = over[0, 0].astype(int), over[0, over.shape[1] // 2].astype(int)
    assert abs(middle - [30, 200, 10]).max() < 4 or abs(corner - [30, 200, 10]).max() < 4, "the middle covers the frame"
    cv2.imwrite(str(tmp_path / "narrow.png"), np.full((4000, 1, 3), (10, 200, 30), np.uint8))
    over = parse_backdrop(str(tmp_path / "narrow.png")).pixels(rendering, trained.background)  # in little memory
    assert over.shape == (*rendering.alpha.shape, 3) and abs(over[0, 0].astype(int) - [30, 200, 10]).max() < 4


@pytest.mark.parametrize(("height", "width", "top", "left"), [(12, 10, 0, 100), (10, 30, 10, 0)])
def test_a_backdrop_is_the_middle_of_its_picture_and_has_no_moire(height: int, width: int, top: int, left: int) -> None:
    row, column = torch.arange(120)[:, None].expand(120, 300), torch.arange(300).expand(120, 300)
    shown = _covering(torch.stack((row, column, 300 * (row % 10 == 0)), dim=-1) / 300, height, width)
    rows, columns = top + 10 * torch.arange(height) + 4.5, left + 10 * torch.arange(width) + 4.5
    expected = (rows[:, None].expand(height, width), columns.expand(height, width), torch.full((height, width), 30.0))
    torch.testing.assert_close(shown, torch.stack(expected, dim=-1) / 300, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("suffix", "options"), [(".mov", ()), (".webm", ("-c:v", "libvpx-vp9"))])
def test_a_transparent_video_has_alpha(
    suffix: str, options: tuple[str, ...], run: Path, drive: Path, tmp_path: Path
) -> None:
    out = tmp_path / f"a{suffix}"
    avatar("reenact", run, drive, "--background", "transparent", "--out", out)
    alpha = decoded(out, "rgba", *options)[:, 3]
    assert alpha.min() < 10 and alpha.max() > 100


def test_an_exported_video_has_a_background(run: Path, tmp_path: Path) -> None:
    words = ("export", run, "--format", "video", "--camera", "still")
    avatar(*words, "--background", "#0000ff", "--out", tmp_path / "a.mp4")
    red, _, blue, _ = decoded(tmp_path / "a.mp4", "rgba")[0]
    assert blue > 200 and red < 60
    avatar(*words, "--background", "transparent", "--out", tmp_path / "a.mov")
    alpha = decoded(tmp_path / "a.mov", "rgba")[:, 3]
    assert alpha.min() < 10 and alpha.max() > 100
    refused = avatar(*words, "--background", "transparent", "--out", tmp_path / "a.mp4", status=1)
    assert "a transparent video is written as .mov or .webm" in refused
    picture = tmp_path / "b.mp4"  # whatever it holds
    picture.write_bytes(b"")
    assert "is an input" in avatar(*words, "--background", picture, "--out", picture, status=1)
    refused = avatar("export", run, "--background", "red", "--out", tmp_path / "a.ply", status=1)
    assert "--background belongs to --format video" in refused


def test_pictures_and_refusals(run: Path, drive: Path, tmp_path: Path) -> None:
    avatar("reenact", run, drive, "--background", "transparent", "--out", tmp_path / "a.png")
    pictures = sorted(tmp_path.glob("a-*.png"))
    assert pictures[0].name == "a-00000.png" and len(pictures) > 1
    assert cv2.imread(str(pictures[0]), cv2.IMREAD_UNCHANGED).shape[2] == 4
    longer = [tmp_path / f"a-{len(pictures) + i:05d}.png" for i in range(2)]  # of an earlier run
    others = [tmp_path / name for name in (f"a-{len(pictures) + 3:05d}.png", "a-20270101.png", "ab-00000.png")]
    for path in (*longer, *others):
        cv2.imwrite(str(path), np.zeros((8, 8, 3), np.uint8))
    said = avatar("reenact", run, drive, "--background", "red", "--out", tmp_path / "a.png")
    assert f"Removed {longer[0]} to {longer[1].name}, of an earlier run" in said
    assert sorted(tmp_path.glob("a*.png")) == sorted([*pictures, *others])
    refused = avatar("reenact", run, drive, "--background", pictures[1], "--out", tmp_path / "a.png", status=1)
    assert f"{pictures[1]} is an input of this command" in refused
    refused = avatar("reenact", run, drive, "--background", "transparent", "--out", tmp_path / "a.mp4", status=1)
    assert "a transparent video is written as .mov or .webm or .png" in refused
    assert "not nothing.jpg" in avatar("reenact", run, drive, "--background", "nothing.jpg", status=1)


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_sound_goes_along_and_changes_no_length(suffix: str, tmp_path: Path) -> None:
    beep, frames = tmp_path / "beep.wav", [np.full((32, 32, 3), 20 * k, np.uint8) for k in range(10)]
    words = [FFMPEG, "-loglevel", "error", "-f", "lavfi", "-i", "sine=frequency=440:duration=0.5", str(beep)]
    subprocess.run(words, check=True)
    for source in (beep, beep_free := tmp_path / "silent.mp4"):
        if source == beep_free:
            write_video(beep_free, frames, 10.0)
        out = tmp_path / f"{source.stem}-out{suffix}"
        write_video(out, frames, 10.0, Sound(source, 0.2, 1.0))
        count, _ = imageio_ffmpeg.count_frames_and_secs(str(out))
        said = subprocess.run([FFMPEG, "-hide_banner", "-i", str(out)], capture_output=True, text=True).stderr
        assert count == 10 and ("Audio:" in said) == (source == beep)


def test_a_damaged_sound_costs_no_picture(tmp_path: Path) -> None:
    sound = tmp_path / "a:b.aac"
    words = [FFMPEG, "-loglevel", "error", "-f", "lavfi", "-i", "sine=frequency=440:duration=1", f"file:{sound}"]
    subprocess.run(words, check=True)
    data = bytearray(sound.read_bytes())
    data[len(data) // 3 : len(data) // 2] = bytes(len(data) // 2 - len(data) // 3)
    sound.write_bytes(data)
    out = tmp_path / "out.mp4"
    write_video(out, [np.full((32, 32, 3), 20 * k, np.uint8) for k in range(10)], 10.0, Sound(sound, 0.0, 1.0))
    assert imageio_ffmpeg.count_frames_and_secs(str(out))[0] == 10


def test_sound_begins_with_the_shot_and_is_left_out_where_frames_are_missing() -> None:
    params, said = [rest_params()] * 3, []
    drive = Drive("a", 10.0, ("00005", "00006", "00007"), params, None, torch.zeros(0))
    assert drive_sound(Path("a.mp4"), 2.0, 10.0, drive, said.append) == Sound(Path("a.mp4"), 2.5, 0.3) and not said
    gap = Drive("a", 10.0, ("00000", "00001", "00009"), params, None, torch.zeros(0))
    assert drive_sound(Path("a.mp4"), 2.0, 10.0, gap, said.append) is None and "lacks 7 frames" in said[0]


def test_a_video_that_is_shown_faster_than_it_was_filmed_is_silent() -> None:
    said = list[str]()
    drive = Drive("a", 20.0, ("00005", "00006"), [rest_params()] * 2, None, torch.zeros(0))
    assert drive_sound(Path("a.mp4"), 2.0, 10.0, drive, said.append) is None and "shown at 20" in said[0]
