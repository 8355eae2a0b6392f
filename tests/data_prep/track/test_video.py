"""Videos of every kind come out upright, with square pixels, at their places and times; what is none is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from videos import LOSSLESS, X264, centre_of, encode, ffmpeg, spot

from avatar.errors import UserError
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.source import MAX_SIDE, MIN_SIDE, Box, Span, View, check_size, whole
from data_prep.track.footage.tone_mapping import has_zimg
from data_prep.track.footage.video import open_video

WIDTH, HEIGHT = 160, 96
AT = (70.3, 40.6)
SUBPIXEL = 0.1  # of a decoded blob's centre; colours of half the resolution and rounding to 8 bits take most of it


def still(count: int = 5, width: int = WIDTH, height: int = HEIGHT) -> list[np.ndarray]:
    return [spot(*AT, width, height)] * count


def counting(count: int) -> list[np.ndarray]:
    """Pictures whose grey is their number."""
    return [np.full((64, 64, 3), 8 * n, np.uint8) for n in range(count)]


def read(path: Path, view: View | None = None, span: Span | None = None) -> tuple[list, list[str]]:
    video, said = open_footage(path), []
    view = view or whole(video.width, video.height)
    return list(video.read(view, span or Span(), said.append)), said


@pytest.mark.parametrize(
    "view",
    [
        View(Box(0, 0, WIDTH, HEIGHT), WIDTH, HEIGHT),
        View(Box(0, 0, WIDTH, HEIGHT), 80, 48),
        View(Box(20, 10, 80, 80), 80, 80),
        View(Box(21, 11, 81, 79), 81, 79),
        View(Box(21, 11, 80, 80), 37, 37),
        View(Box(31, 1, 90, 90), 150, 150),
    ],
)
@pytest.mark.parametrize(("name", "options"), [("a.mkv", LOSSLESS), ("a.mp4", X264)])
def test_a_point_is_where_the_view_says(tmp_path: Path, name: str, options: tuple[str, ...], view: View) -> None:
    encode(tmp_path / name, still(2), options=options)
    pictures, said = read(tmp_path / name, view)
    assert not said and pictures[0].image.shape == (view.height, view.width, 3)
    scale = view.width / view.box.width
    assert centre_of(pictures[0].image) == pytest.approx(view.to_view(*AT), abs=SUBPIXEL * max(1, scale))


def test_colours_survive(tmp_path: Path) -> None:
    encode(tmp_path / "a.mkv", still(2), options=LOSSLESS)
    pictures, _ = read(tmp_path / "a.mkv")
    np.testing.assert_array_equal(pictures[1].image, still()[0])


@pytest.mark.parametrize(("height", "matrix"), [(720, "bt709"), (480, "smpte170m")])
def test_a_video_without_a_tag_has_the_colours_that_players_show(tmp_path: Path, height: int, matrix: str) -> None:
    made = f"scale=out_color_matrix={matrix},format=yuv420p,setparams=colorspace=unknown"
    encode(tmp_path / "a.mp4", [np.full((height, 64, 3), (180, 60, 40), np.uint8)] * 2, options=("-vf", made, *X264))
    assert open_video(tmp_path / "a.mp4").colour[1] == "unknown"
    for view in (None, View(Box(4, 4, 56, 56), 28, 28)):
        pictures, _ = read(tmp_path / "a.mp4", view)
        assert np.abs(pictures[0].image.astype(int) - (180, 60, 40)).max() <= 3


def test_rotation_in_the_metadata_is_applied_and_said(tmp_path: Path) -> None:
    encode(tmp_path / "a.mp4", [np.rot90(image, -1) for image in still()])
    ffmpeg("-display_rotation", "90", "-i", tmp_path / "a.mp4", "-c", "copy", tmp_path / "b.mp4")
    video = open_video(tmp_path / "b.mp4")
    assert (video.width, video.height) == (WIDTH, HEIGHT)
    assert video.notes == (f"the video is turned upright as its metadata say: {WIDTH}x{HEIGHT} pixels",)
    pictures, _ = read(tmp_path / "b.mp4")
    assert centre_of(pictures[0].image) == pytest.approx(AT, abs=SUBPIXEL)


def test_pixels_become_square(tmp_path: Path) -> None:
    encode(tmp_path / "a.mp4", still(), options=("-vf", "setsar=3/2", *X264))
    video = open_video(tmp_path / "a.mp4")
    assert (video.width, video.height) == (240, HEIGHT) and "not square: 160x96 are shown as 240x96" in video.notes[0]
    view = View(Box(64, 2, 90, 90), 90, 90)
    pictures, _ = read(tmp_path / "a.mp4", view)
    assert centre_of(pictures[0].image) == pytest.approx((1.5 * AT[0] - 64, AT[1] - 2), abs=2 * SUBPIXEL)


def test_nearly_square_pixels_are_left_alone(tmp_path: Path) -> None:
    """As a converter's rounding makes them: to stretch every picture by a pixel would only blur it."""
    encode(tmp_path / "a.mp4", still(), options=("-vf", "setsar=300/301", *X264))
    video = open_video(tmp_path / "a.mp4")
    assert (video.width, video.height, video.notes) == (WIDTH, HEIGHT, ())


def test_odd_sizes(tmp_path: Path) -> None:
    encode(tmp_path / "a.mkv", still(3, 151, 97), options=("-c:v", "ffv1", "-pix_fmt", "bgr0"))
    video = open_video(tmp_path / "a.mkv")
    assert (video.width, video.height) == (151, 97)
    pictures, _ = read(tmp_path / "a.mkv")
    np.testing.assert_array_equal(pictures[2].image, still(1, 151, 97)[0])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.mov", ("-c:v", "qtrle")),
        ("a.webm", ("-c:v", "libvpx-vp9", "-pix_fmt", "yuva420p", "-b:v", "2M")),
    ],
)
def test_transparent_parts_lie_over_grey(tmp_path: Path, name: str, options: tuple[str, ...]) -> None:
    image = np.full((64, 64, 4), (200, 40, 40, 255), np.uint8)
    image[:32, :, 3] = 0
    encode(tmp_path / name, [image] * 4, options=options)
    pictures, said = read(tmp_path / name)
    assert said == ["the pictures are transparent in parts: they are laid over grey"]
    assert np.abs(pictures[0].image[:24].astype(int) - 127).max() <= 4
    assert np.abs(pictures[0].image[40:].astype(int) - (200, 40, 40)).max() <= 8


@pytest.mark.skipif(not has_zimg(), reason="this ffmpeg has no zimg, which tone-maps")
@pytest.mark.parametrize(("transfer", "name"), [("smpte2084", "PQ"), ("arib-std-b67", "HLG")])
def test_high_dynamic_range_is_tone_mapped_and_said(tmp_path: Path, transfer: str, name: str) -> None:
    grey = [np.full((64, 64, 3), level, np.uint8) for level in (40, 120, 220)]
    made = f"zscale=tin=bt709:min=gbr:pin=bt709:rin=pc:t={transfer}:m=bt2020nc:p=bt2020:r=tv:npl=100,format=yuv420p10le"
    tags = ("-color_primaries", "bt2020", "-color_trc", transfer, "-colorspace", "bt2020nc")
    encode(tmp_path / "a.mp4", grey, options=("-vf", made, "-c:v", "libx265", "-x265-params", "log-level=error", *tags))
    video = open_video(tmp_path / "a.mp4")
    assert video.notes == (f"the video is HDR ({name}): its colours are tone-mapped to those of a usual screen",)
    pictures, _ = read(tmp_path / "a.mp4")
    levels = [picture.image.mean() for picture in pictures]
    assert levels == sorted(levels) and levels[2] - levels[0] > 80  # neither flat as undecoded PQ is, nor clipped
    assert all(np.ptp(picture.image.reshape(-1, 3).mean(0)) < 4 for picture in pictures)  # grey stays grey


def test_times_and_the_part_between_start_and_end(tmp_path: Path) -> None:
    for name, options in (("a.mp4", X264), ("a.mkv", X264), ("a.gif", ()), ("a.h264", X264)):
        encode(tmp_path / name, counting(30), 10, options)
        pictures, said = read(tmp_path / name)
        assert [p.time for p in pictures] == pytest.approx([n / 10 for n in range(30)], abs=1e-3), name
        part, _ = read(tmp_path / name, span=Span(1.0, 2.0))
        assert [p.time for p in part] == pytest.approx([n / 10 for n in range(10, 20)], abs=1e-3), name
        assert [p.image.mean() for p in part] == pytest.approx([8 * n for n in range(10, 20)], abs=3), name
        assert not said


@pytest.mark.parametrize(("name", "codec"), [("a.ts", "libx264"), ("a.mpg", "mpeg2video")])
def test_nothing_is_lost_after_a_start_where_there_is_no_index(tmp_path: Path, name: str, codec: str) -> None:
    encode(tmp_path / name, counting(25) * 4, options=("-c:v", codec, "-g", "12", "-bf", "2"))
    (whole_clip, _), (part, said) = read(tmp_path / name), read(tmp_path / name, span=Span(2.5))
    assert [picture.time for picture in part] == [picture.time for picture in whole_clip[63:]] and not said
    np.testing.assert_array_equal(part[0].image, whole_clip[63].image)


def test_a_variable_rate_keeps_its_times(tmp_path: Path) -> None:
    encode(tmp_path / "a.mp4", counting(20), 25)
    late = "setpts='(N+if(gt(N,9),5,0))/25/TB'"
    ffmpeg("-i", tmp_path / "a.mp4", "-vf", late, "-fps_mode", "passthrough", *X264, tmp_path / "b.mkv")
    pictures, _ = read(tmp_path / "b.mkv")
    steps = np.diff([picture.time for picture in pictures])
    assert (
        len(pictures) == 20 and steps[9] == pytest.approx(0.24, abs=2e-3) and steps[3] == pytest.approx(0.04, abs=2e-3)
    )


def test_a_high_rate_is_thinned_and_said(tmp_path: Path) -> None:
    encode(tmp_path / "a.mp4", counting(24), 240)
    video = open_video(tmp_path / "a.mp4")
    assert video.notes == ("of 240 pictures a second every 8th is used, 30 a second",)
    pictures, _ = read(tmp_path / "a.mp4")
    assert [p.image.mean() for p in pictures] == pytest.approx([0, 64, 128], abs=3)


@pytest.mark.parametrize("options", [("-f", "matroska"), ("-f", "matroska", "-live", "1")])  # as browsers record
def test_a_high_rate_is_thinned_from_the_start_on(options: tuple[str, ...], tmp_path: Path) -> None:
    """Whether the file can be entered there or not."""
    encode(tmp_path / "a.mkv", counting(24), 50, (*LOSSLESS, *options))
    assert (open_video(tmp_path / "a.mkv").duration is None) == ("-live" in options)
    pictures, _ = read(tmp_path / "a.mkv", span=Span(0.1, 0.2))
    assert [p.image.mean() for p in pictures] == pytest.approx([40, 56, 72], abs=1)


def test_the_lens_in_the_metadata(tmp_path: Path) -> None:
    tag = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
    encode(tmp_path / "a.mov", still(), options=("-metadata", f"{tag}=26", "-movflags", "use_metadata_tags", *X264))
    assert open_video(tmp_path / "a.mov").equivalent_focal == 26
    encode(tmp_path / "b.mov", still(), options=("-metadata", f"{tag}=99999", "-movflags", "use_metadata_tags", *X264))
    assert open_video(tmp_path / "b.mov").equivalent_focal is None


def test_the_largest_of_several_videos_is_used(tmp_path: Path) -> None:
    encode(tmp_path / "small.mp4", counting(5))
    encode(tmp_path / "large.mp4", still())
    maps = ("-map", "0", "-map", "1", "-c", "copy")
    ffmpeg("-i", tmp_path / "small.mp4", "-i", tmp_path / "large.mp4", *maps, tmp_path / "both.mp4")
    video = open_video(tmp_path / "both.mp4")
    assert (video.width, video.stream) == (WIDTH, 1) and video.notes == (
        "the file holds 2 videos: the largest is used",
    )


def test_a_language_with_a_region_hides_no_pictures(tmp_path: Path) -> None:
    encode(tmp_path / "a.mkv", still(3), options=("-metadata:s:v:0", "language=en-US", *X264))
    assert len(read(tmp_path / "a.mkv")[0]) == 3


def test_a_changing_size_is_refused(tmp_path: Path) -> None:
    first, second = encode(tmp_path / "a.ts", still()), encode(tmp_path / "b.ts", counting(5))
    (tmp_path / "c.ts").write_bytes(first.read_bytes() + second.read_bytes())
    with pytest.raises(UserError, match="c.ts changes from 160x96 to 64x64 pixels after 5 pictures; cut it there"):
        read(tmp_path / "c.ts")


def test_damage_is_said(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (64, 64, 3), np.uint8) for _ in range(90)]
    whole_file = encode(tmp_path / "a.mkv", noise, options=(*X264, "-g", "10")).read_bytes()
    (tmp_path / "b.mkv").write_bytes(whole_file[: len(whole_file) // 3])
    pictures, said = read(tmp_path / "b.mkv")
    assert 5 < len(pictures) < 90 and len(said) == 2
    assert said[0].startswith("the video is damaged: ffmpeg complains")
    assert said[1].startswith("the video says that it is 3.6 s long, but its pictures end after")


def test_damage_before_the_end_is_said_and_behind_it_is_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (64, 64, 3), np.uint8) for _ in range(90)]
    data = bytearray(encode(tmp_path / "a.mp4", noise, options=(*X264, "-g", "10")).read_bytes())
    for place in range(len(data) // 3, len(data) // 2, 400):
        data[place : place + 40] = bytes(40)
    (tmp_path / "b.mp4").write_bytes(data)
    pictures, said = read(tmp_path / "b.mp4", span=Span(0.0, 3.0))
    assert len(pictures) < 75 and len(said) == 1 and said[0].startswith("the video is damaged: ffmpeg complains")
    pictures, said = read(tmp_path / "b.mp4", span=Span(0.0, 0.6))
    assert len(pictures) == 15 and not said


REFUSED = {
    "text.mp4": (b"hello\n" * 100, "text.mp4 is not a video that ffmpeg can read (Invalid data found"),
    "text.txt": (b"hello\n" * 100, "text.txt is a text, not a video"),
    "empty.mp4": (b"", "empty.mp4 is empty; copy or record it again"),
    "noise.mkv": (bytes(range(256)) * 400, "noise.mkv is not a video that ffmpeg can read"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_no_videos(tmp_path: Path, name: str) -> None:
    content, sentence = REFUSED[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError) as caught:
        open_video(tmp_path / name)
    assert sentence in str(caught.value)


def test_videos_without_pictures(tmp_path: Path) -> None:
    ffmpeg("-f", "lavfi", "-i", "sine=d=0.5", tmp_path / "sound.mp4")
    with pytest.raises(UserError, match="sound.mp4 has no pictures: it holds audio; give a video"):
        open_video(tmp_path / "sound.mp4")
    ffmpeg("-f", "lavfi", "-i", "color=s=64x64:d=0.04", "-frames:v", "1", tmp_path / "cover.png")
    cover = ("-map", "0", "-map", "1", "-c:v", "mjpeg", "-disposition:v", "attached_pic")
    ffmpeg("-f", "lavfi", "-i", "sine=d=0.5", "-i", tmp_path / "cover.png", *cover, tmp_path / "song.m4a")
    with pytest.raises(UserError, match="song.m4a has no pictures: it holds audio and a cover picture"):
        open_video(tmp_path / "song.m4a")


def test_a_copy_that_was_cut_short(tmp_path: Path) -> None:
    content = encode(tmp_path / "a.mp4", still()).read_bytes()
    for kept in (content.index(b"moov") - 8, content.index(b"moov") + 200):  # before the index, and inside it
        (tmp_path / "b.mp4").write_bytes(content[:kept])
        with pytest.raises(UserError, match="b.mp4 is cut short: the index at its end is missing"):
            open_video(tmp_path / "b.mp4")


def test_a_list_of_other_files_is_not_followed(tmp_path: Path) -> None:
    encode(tmp_path / "a.mp4", still())
    (tmp_path / "list.ffconcat").write_text("ffconcat version 1.0\nfile a.mp4\n")
    with pytest.raises(UserError, match=r"list.ffconcat is a list of other files \(concat\)"):
        open_video(tmp_path / "list.ffconcat")


def test_impossible_sizes(tmp_path: Path) -> None:
    encode(tmp_path / "a.mp4", [np.zeros((32, 48, 3), np.uint8)] * 3)
    with pytest.raises(UserError, match="a.mp4 has pictures of 48x32 pixels; a face needs 64 at least"):
        open_video(tmp_path / "a.mp4")
    check_size(tmp_path, MAX_SIDE, MIN_SIDE)
    with pytest.raises(UserError, match=f"pictures of 64x{MAX_SIDE + 1} pixels; more than {MAX_SIDE} a side"):
        check_size(tmp_path, 64, MAX_SIDE + 1)
    ffmpeg("-f", "lavfi", "-i", "color=s=8200x8200:d=0.04", "-frames:v", "1", "-c:v", "png", tmp_path / "b.mov")
    with pytest.raises(UserError, match="none of the pictures in .*b.mov can be decoded"):
        open_video(tmp_path / "b.mov")


def test_names_that_mean_something_to_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("-i.mp4", "a%03d.mp4", "pipe:0.mp4", "concat:a|b.mp4"):
        encode(tmp_path / "plain.mp4", counting(3)).rename(tmp_path / name)
        assert len(read(Path(name))[0]) == 3
