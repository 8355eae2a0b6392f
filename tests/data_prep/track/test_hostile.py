"""Thirty videos that nobody should have given: a sentence each, and nothing half-written."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from videos import X264, encode, ffmpeg, talking

from avatar.cli import main
from data_prep.track.first_pass import look_at
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.source import Span

pytestmark = pytest.mark.slow

FRAMES, SIZE = 20, 160


def person(seed: int = 1) -> list[np.ndarray]:
    return list(talking(FRAMES, SIZE, seed))


def grey(count: int, level: int = 0) -> list[np.ndarray]:
    return [np.full((SIZE, SIZE, 3), level, np.uint8)] * count


def noise(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (SIZE, SIZE, 3), np.uint8) for _ in range(count)]


def beside(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The right one smaller."""
    small = cv2.resize(right, (100, 100), interpolation=cv2.INTER_AREA)
    return np.concatenate((left, cv2.copyMakeBorder(small, 30, 30, 0, 0, cv2.BORDER_REPLICATE)), axis=1)


def pictures(folder: Path, images: list[np.ndarray], spoil: Callable[[Path], object] = lambda path: None) -> Path:
    folder.mkdir()
    for n, image in enumerate(images):
        cv2.imwrite(str(folder / f"{n}.png"), image[..., ::-1])
    if images[5:]:
        spoil(folder / "5.png")
    return folder


def cut(source: Path, target: Path, share: float) -> Path:
    content = source.read_bytes()
    target.write_bytes(content[: int(share * len(content))])
    return target


def holes(source: Path, target: Path) -> Path:
    """Bytes changed in the middle fifth of the pictures' data."""
    content = bytearray(source.read_bytes())
    first, last = content.find(b"mdat"), content.find(b"moov")
    rng = np.random.default_rng(1)
    for at in range(first + (last - first) * 2 // 5, first + (last - first) * 3 // 5, 7):
        content[at] = rng.integers(256)
    target.write_bytes(content)
    return target


def filtered(folder: Path, name: str, *options: str) -> Path:
    ffmpeg("-i", encode(folder / "plain.mp4", person()), *options, folder / name)
    return folder / name


def joined(folder: Path) -> Path:
    parts = [encode(folder / "a.ts", person()), encode(folder / "b.ts", [i[:96, :96] for i in person()])]
    (folder / "v.ts").write_bytes(b"".join(part.read_bytes() for part in parts))
    return folder / "v.ts"


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


# name -> (how it is made, what is said)
REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no face": (lambda f: encode(f / "v.mp4", noise(12)), "no face was found in any of the 12 pictures of"),
    "black": (lambda f: encode(f / "v.mp4", grey(12)), "no face was found in any of the 12 pictures of"),
    "one picture": (lambda f: encode(f / "v.mp4", person()[:1]), "v.mp4 has 1 picture; 10 at least are needed"),
    "a photograph": (
        lambda f: pictures(f / "v", person()[:1]),
        "v has 1 picture; 10 at least are needed",
    ),
    "a few faces": (lambda f: encode(f / "v.mp4", [*person()[:6], *noise(6)]), "one face was found in only"),
    "a missing file": (lambda f: f / "v.mp4", "v.mp4 does not exist"),
    "an empty file": (lambda f: written(f / "v.mp4", b""), "v.mp4 is empty; copy or record it again"),
    "a text": (lambda f: written(f / "v.mp4", b"hello\n" * 99), "v.mp4 is not a video that ffmpeg can read"),
    "a text as it is": (lambda f: written(f / "v.txt", b"hello\n" * 99), "v.txt is a text, not a video"),
    "random bytes": (
        lambda f: written(f / "v.avi", noise(1)[0].tobytes()),
        "v.avi is not a video that ffmpeg can read",
    ),
    "truncated": (
        lambda f: cut(encode(f / "a.mp4", person()), f / "v.mp4", 0.7),
        "v.mp4 is cut short: the index at its end is missing",
    ),
    "a stream of nothing": (
        lambda f: filtered(f, "v.mkv", "-frames:v", "0", *X264),
        "v.mkv is not a video that ffmpeg can read",
    ),
    "a size that changes": (joined, "changes from 160x160 to 96x96 pixels after 20 pictures"),
    "a folder of nothing": (lambda f: pictures(f / "v", []), "holds no PNG or JPEG pictures"),
    "sizes that differ": (
        lambda f: pictures(f / "v", person(), lambda p: cv2.imwrite(str(p), person()[0][:99])),
        "5.png is 160x99 pixels but 0.png is 160x160; give pictures of one size",
    ),
    "a broken picture": (
        lambda f: pictures(f / "v", person(), lambda p: cut(p, p, 0.5)),
        "5.png is cut short; write or copy it again",
    ),
    "a start behind the end": (lambda f: encode(f / "v.mp4", person()), "--start 99 is behind the end of the video"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(
    name: str, tmp_path: Path, tracking_models: None, demo_head_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make, sentence = REFUSED[name]
    video = make(tmp_path)
    before = sorted(tmp_path.iterdir())
    start = ["--start", "99"] if name == "a start behind the end" else []
    status = main(["track", str(video), "--head", str(demo_head_model), "--out", str(tmp_path / "out"), *start])
    said = [line for line in capsys.readouterr().err.replace("\r", "\n").splitlines() if line.startswith("avatar: ")]
    assert status == 1 and len(said) == 1 and sentence in said[0], said
    assert sorted(tmp_path.iterdir()) == before


@dataclasses.dataclass(frozen=True)
class Taken:
    make: Callable[[Path], Path]
    notes: tuple[str, ...] = ()  # parts of what is said
    frames: int = FRAMES  # with a face, at least
    size: tuple[int, int] = (SIZE, SIZE)
    fps: float = 25.0


def wide(image: np.ndarray) -> np.ndarray:
    return cv2.copyMakeBorder(image, 40, 60, 0, 0, cv2.BORDER_REPLICATE)


def half_clear(image: np.ndarray) -> np.ndarray:
    alpha = np.full((*image.shape[:2], 1), 255, np.uint8)
    alpha[:20] = 0
    return np.concatenate((image, alpha), axis=2)


HDR = (
    "-vf", "zscale=tin=bt709:min=gbr:pin=bt709:rin=pc:t=smpte2084:m=bt2020nc:p=bt2020:r=tv:npl=100,format=yuv420p10le",
    "-c:v", "libx265", "-x265-params", "log-level=error",
    "-color_primaries", "bt2020", "-color_trc", "smpte2084", "-colorspace", "bt2020nc",
)  # fmt: skip
UNEVEN = ("-vf", "setpts='(N+if(gt(N,7),3,0))/25/TB'", "-fps_mode", "passthrough", *X264)
LARGE = ("-vf", "scale=4320:4320,pad=7680:4320:1680:0", "-c:v", "libx264", "-preset", "ultrafast")

TAKEN = {
    "two faces": Taken(
        lambda f: encode(f / "v.mp4", [beside(a, b) for a, b in zip(person(), person(2), strict=True)]),
        ("another face is beside it in",),
        size=(260, 160),
    ),
    "two shots": Taken(
        lambda f: encode(f / "v.mp4", [*person()[:8], *person(2)]),
        (
            "the video is cut into 2 shots: the one with the most pictures of a face is used, 0.8 s from 0.3 s on (20 of "
            "28 pictures)",
        ),
    ),
    "portrait": Taken(lambda f: encode(f / "v.mp4", [wide(i) for i in person()]), size=(160, 260)),
    "rotated": Taken(
        lambda f: _turned(f), ("the video is turned upright as its metadata say: 160x260 pixels",), size=(160, 260)
    ),
    "odd sizes": Taken(
        lambda f: encode(f / "v.mkv", [wide(i)[:, :159] for i in person()], options=("-c:v", "ffv1")), size=(159, 260)
    ),
    "8K": Taken(lambda f: filtered(f, "v.mp4", *LARGE), size=(7680, 4320)),
    "variable rate": Taken(lambda f: filtered(f, "v.mkv", *UNEVEN), ("the frame rate varies (40 to 160 ms",)),
    "1 a second": Taken(lambda f: encode(f / "v.mp4", person(), 1), ("neighbours are too unlike",), fps=1.0),
    "240 a second": Taken(lambda f: encode(f / "v.mp4", [i for i in person() for _ in range(8)], 240), fps=30.0),
    "transparent": Taken(
        lambda f: encode(f / "v.mov", [half_clear(i) for i in person()], options=("-c:v", "qtrle")),
        ("the pictures are transparent in parts: they are laid over grey",),
    ),
    "an animated GIF": Taken(lambda f: encode(f / "v.gif", person(), options=())),
    "a folder of pictures": Taken(lambda f: pictures(f / "v", person())),
    "10-bit HDR": Taken(lambda f: encode(f / "v.mp4", person(), options=HDR)),
    "without colour": Taken(lambda f: encode(f / "v.mp4", person(), options=("-c:v", "libx264", "-pix_fmt", "gray"))),
    "interlaced": Taken(
        lambda f: encode(f / "v.mpg", person(), options=("-c:v", "mpeg2video", "-flags", "+ildct+ilme", "-b:v", "4M")),
    ),
    "a broken middle": Taken(
        lambda f: holes(encode(f / "a.mp4", person(), options=(*X264, "-g", "8")), f / "v.mp4"),
        ("the video is damaged: ffmpeg complains",),
        frames=12,
    ),
    "an end that is missing": Taken(
        lambda f: cut(encode(f / "a.mkv", person()), f / "v.mkv", 0.8), ("the video is damaged",), frames=12
    ),
}


def _turned(folder: Path) -> Path:
    encode(folder / "a.mp4", [np.rot90(wide(i), -1) for i in person()])
    ffmpeg("-display_rotation", "90", "-i", folder / "a.mp4", "-c", "copy", folder / "v.mp4")
    return folder / "v.mp4"


@pytest.mark.slow
@pytest.mark.parametrize("name", TAKEN)
def test_taken_and_said(name: str, tmp_path: Path, tracking_models: None) -> None:
    case = TAKEN[name]
    footage = open_footage(case.make(tmp_path))
    look = look_at(footage, Span(), lambda items, total, title: items)
    said = [*footage.notes, *look.notes]
    for part in case.notes:
        assert any(part in note for note in said), said
    assert look.landmarks.size == case.size and look.landmarks.fps == pytest.approx(case.fps)
    detected = look.landmarks.detected
    assert case.frames <= detected.sum() <= FRAMES
    points = look.landmarks.points[detected]
    assert (points[..., :2].min(axis=(0, 1)) > 0).all() and (points[..., :2].max(axis=(0, 1)) < case.size).all()
    assert not look.landmarks.points[~detected].any()


def test_a_long_video_is_cut_at_the_limit(
    tmp_path: Path, tracking_models: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("data_prep.track.first_pass.MAX_PICTURES", 12)
    look = look_at(open_footage(encode(tmp_path / "v.mp4", person())), Span(), lambda items, total, title: items)
    assert len(look.landmarks) == 12 and not look.is_whole
    assert look.notes == [
        "the clip is longer than 12 pictures: those from 0.0 to 0.5 s are used; --start and --end choose others"
    ]
