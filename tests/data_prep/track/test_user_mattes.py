"""Mattes given with --matte: labels are understood, what does not show the person is refused before any stage is made."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from heads import grid_head
from marked_face import HEIGHT, WIDTH, matte, picture
from PIL import Image
from videos import LOSSLESS, X264, encode, ffmpeg

from avatar.data.read_image import read_mask
from avatar.errors import UserError
from data_prep.formats.avatar_track import read_info
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.source import Span, View, whole
from data_prep.track.mattes.user_mattes import open_mattes, share_on
from data_prep.track.track import Choices, track

FRAMES = 12
Write = Callable[[Path, np.ndarray], object]

pytestmark = pytest.mark.usefixtures("with_marks")


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("video")
    return encode(folder / "v.mkv", [picture(n % 5) for n in range(FRAMES)], options=LOSSLESS)


def as_folder(folder: Path, write: Write, frames: int = FRAMES) -> Path:
    folder.mkdir()
    for n in range(frames):
        write(folder / f"{n}.png", matte(n % 5))
    return folder


def as_video(path: Path, change: Callable[[np.ndarray], np.ndarray], options: tuple[str, ...] = LOSSLESS) -> Path:
    def three(mask: np.ndarray) -> np.ndarray:
        return mask if mask.ndim == 3 else np.dstack((mask, mask, mask))

    return encode(path, [three(change(matte(n % 5))) for n in range(FRAMES)], options=options)


def tracked(folder: Path, video: Path, mattes: Path) -> tuple[Path, list[str]]:
    (folder / "head.npz").touch()
    said: list[str] = []
    choices = Choices(crop="none", matte=mattes)
    track(video, folder / "out", folder / "head.npz", grid_head(), choices, say=said.append)
    return folder / "out", said


def changed(change: Callable[[np.ndarray], np.ndarray]) -> Write:
    return lambda path, mask: cv2.imwrite(str(path), change(mask))


def with_palette(path: Path, mask: np.ndarray) -> None:
    image = Image.frombytes("P", mask.shape[::-1], (mask // 255).tobytes())
    image.putpalette([68, 1, 84, 253, 231, 37, *[0] * 762])  # a background that is not black
    image.save(path)


def cut_out(mask: np.ndarray) -> np.ndarray:
    return np.dstack((np.full_like(mask, 90), np.full_like(mask, 200), np.full_like(mask, 10), mask))


UNDERSTOOD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "0 and 255": (lambda f: as_folder(f / "m", changed(lambda m: m)), ""),
    "0 and 1": (lambda f: as_folder(f / "m", changed(lambda m: m // 255)), "1 is read as 255"),
    "0 and 38 in 16 bits": (
        lambda f: as_folder(f / "m", changed(lambda m: (m // 255).astype(np.uint16) * 38)),
        "38 is read as 255",
    ),
    "0 and 65535": (lambda f: as_folder(f / "m", changed(lambda m: m.astype(np.uint16) * 257)), ""),
    "a palette": (lambda f: as_folder(f / "m", with_palette), "1 is read as 255"),
    "the transparency of cut-outs": (lambda f: as_folder(f / "m", changed(cut_out)), ""),
    "a video": (lambda f: as_video(f / "m.mkv", lambda m: m), ""),
}


@pytest.mark.parametrize("kind", UNDERSTOOD)
def test_mattes_are_understood_and_labels_said(kind: str, video: Path, tmp_path: Path) -> None:
    make, note = UNDERSTOOD[kind]
    mattes = open_mattes(make(tmp_path), open_footage(video))
    for n, read in enumerate(mattes.read(whole(WIDTH, HEIGHT), Span())):
        np.testing.assert_array_equal(read.image, matte(n % 5))
    assert len(mattes.notes) == bool(note) and all(note in line for line in mattes.notes)


def test_a_compressed_video_is_taken_as_it_is(video: Path, tmp_path: Path) -> None:
    mattes = open_mattes(as_video(tmp_path / "m.mp4", lambda m: m, X264), open_footage(video))
    assert mattes.notes == ()
    for n, read in enumerate(mattes.read(whole(WIDTH, HEIGHT), Span())):
        assert np.abs(read.image.astype(int) - matte(n % 5)).mean() < 3


def test_labels_end_in_the_folder_as_mattes_and_in_its_notes(video: Path, tmp_path: Path) -> None:
    out, said = tracked(tmp_path, video, as_folder(tmp_path / "m", with_palette))
    made = cv2.imread(str(out / "matte" / "00007.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(made, matte(2))
    (note,) = (line for line in said if "label images" in line)
    assert note.removeprefix("note: ") in read_info(out).notes

    def no_number(text: str) -> None:
        raise AssertionError(f"{text} is no JSON")

    json.loads((out / "tracking.json").read_text(), parse_constant=no_number)


INVERTED = "are inverted: 0% of the face and 8"
REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "inverted": (lambda f: as_folder(f / "m", changed(lambda m: 255 - m)), INVERTED),
    "inverted labels": (lambda f: as_folder(f / "m", changed(lambda m: 1 - m // 255)), INVERTED),
    "an inverted video": (lambda f: as_video(f / "m.mkv", lambda m: 255 - m), INVERTED),
    "an inverted, compressed video": (lambda f: as_video(f / "m.mp4", lambda m: 255 - m, X264), INVERTED),
    "a video of labels": (lambda f: as_video(f / "m.mkv", lambda m: m // 255), "reach only 1 of 255 (values 0, 1)"),
    "black": (lambda f: as_folder(f / "m", changed(lambda m: m * 0)), "are all black: nobody is in them"),
    "a black video": (lambda f: as_video(f / "m.mp4", lambda m: m * 0, X264), "are all black"),
    "white": (lambda f: as_folder(f / "m", changed(lambda m: m | 255)), "are 255 of 255 everywhere"),
    "a white video": (lambda f: as_video(f / "m.mkv", lambda m: m | 255), "are 255 of 255 everywhere"),
    "ones": (lambda f: as_folder(f / "m", changed(lambda m: m * 0 + 1)), "are 1 of 255 everywhere"),
    "nearly white": (
        lambda f: as_folder(f / "m", changed(lambda m: np.maximum(m, 252))),
        "are nowhere below 252 of 255",
    ),
    "two labels": (
        lambda f: as_folder(f / "m", changed(lambda m: m // 255 + np.roll(m, 20) // 255)),
        "reach only 2 of 255 (values 0, 1, 2)",
    ),
    "half transparent": (
        lambda f: as_folder(f / "m", changed(lambda m: cv2.blur(m // 2, (5, 5)))),
        "reach only 127 of 255",
    ),
    "pictures in colour": (
        lambda f: as_folder(f / "m", changed(lambda m: np.dstack((m, m // 2, m // 4)))),
        "is a picture in colour",
    ),
    "the video itself": (lambda f: as_video(f / "m.mkv", lambda m: picture()), "is a picture in colour"),
    "somebody else": (
        lambda f: as_folder(f / "m", changed(lambda m: np.where(np.arange(WIDTH) > 120, np.uint8(255), m * 0))),
        "are not of this person: 0% of the face",
    ),
    "another size": (
        lambda f: as_folder(f / "m", changed(lambda m: m[:100])),
        f"are {WIDTH}x100 pixels, the video {WIDTH}x{HEIGHT}",
    ),
    "a damaged one": (
        lambda f: (
            as_folder(f / "m", lambda p, m: p.write_bytes(cv2.imencode(".png", m)[1].tobytes()[:-20])),
            f / "m",
        )[1],
        "is cut short",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_mattes_without_the_person_are_refused_before_any_stage(
    kind: str, video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("a stage is made first")

    monkeypatch.setattr("data_prep.track.track.look_at", never)
    make, sentence = REFUSED[kind]
    with pytest.raises(UserError) as caught:
        tracked(tmp_path, video, make(tmp_path))
    assert sentence in str(caught.value) and str(tmp_path / "m") in str(caught.value)
    assert not (tmp_path / "out").exists() and not (tmp_path / ".out.partial").exists()


def test_another_value_among_labels_is_named_where_it_is(video: Path, tmp_path: Path) -> None:
    """Only some files are looked at first."""
    (tmp_path / "m").mkdir()
    for n in range(60):
        cv2.imwrite(str(tmp_path / "m" / f"{n}.png"), np.where(matte() > 0, np.uint8(2 if n == 1 else 1), np.uint8(0)))
    mattes = open_mattes(tmp_path / "m", open_footage(video))
    with pytest.raises(UserError, match="1.png holds the value 2 beside 0 and 1"):
        list(mattes.read(whole(WIDTH, HEIGHT), Span()))


def test_labels_are_cut_and_made_smaller_as_mattes_are(video: Path, tmp_path: Path) -> None:
    """Means of labels are other labels."""
    view = View(whole(WIDTH, HEIGHT).box._replace(x=21, width=100), 50, 60)
    folder = open_mattes(as_folder(tmp_path / "m", changed(lambda m: m // 255)), open_footage(video))
    first = next(folder.read(view, Span())).image
    expected = cv2.resize(matte()[:, 21:121], (50, 60), interpolation=cv2.INTER_AREA)
    assert first.shape == (60, 50) and np.abs(first.astype(int) - expected).max() <= 1


@pytest.mark.parametrize("rate", [50, 30])
def test_a_folder_of_mattes_has_the_times_of_the_video(rate: int, tmp_path: Path) -> None:
    """Also where a part is used, or every second picture of a fast video."""
    video = encode(tmp_path / "v.mkv", [picture()] * 40, fps=rate, options=LOSSLESS)
    folder = tmp_path / "m"
    folder.mkdir()
    for n in range(40):
        mask = matte()
        mask[0, 0] = n
        cv2.imwrite(str(folder / f"{n}.png"), mask)
    footage, span = open_footage(video), Span(0.2, 0.6)
    mattes = open_mattes(folder, footage, span)
    pictures = [p.time for p in footage.read(whole(WIDTH, HEIGHT), span, lambda _: None)]
    read = [(p.time, int(p.image[0, 0])) for p in mattes.read(whole(WIDTH, HEIGHT), span)]
    assert [time for time, _ in read] == pytest.approx(pictures, abs=2e-3)
    assert [round(time * rate) for time in pictures] == [n for _, n in read]


TIMES = {  # of picture n, in seconds
    "later than the sound": "N/25+0.08",
    "of a varying rate": "if(lt(N,20),N/25,0.8+(N-20)/15)",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", TIMES)
def test_mattes_of_a_part_are_of_its_own_pictures(kind: str, tmp_path: Path) -> None:
    """Wherever the part begins and ends, whatever times the pictures have."""
    folder, count = tmp_path / "m", 60
    folder.mkdir()
    for n in range(count):
        cv2.imwrite(str(folder / f"{n}.png"), np.maximum(matte(), 4 * n * (np.arange(WIDTH) > 140)).astype(np.uint8))
    greys = [np.full((HEIGHT, WIDTH, 3), 4 * n, np.uint8) for n in range(count)]
    plain = encode(tmp_path / "a.mkv", greys, options=LOSSLESS)
    silence = ("-f", "lavfi", "-i", "anullsrc=d=3", "-c:a", "pcm_s16le")
    kept = (
        "-vf",
        f"setpts='round(({TIMES[kind]})/TB)'",
        "-fps_mode",
        "passthrough",
        "-enc_time_base",
        "1/24000",
        *LOSSLESS,
    )
    ffmpeg("-i", plain, *silence, *kept, tmp_path / "v.mov")
    video, view = open_footage(tmp_path / "v.mov"), whole(WIDTH, HEIGHT)
    as_pictures = [np.dstack([read_mask(folder / f"{n}.png")] * 3) for n in range(count)]
    as_a_video = encode(tmp_path / "m.mkv", as_pictures, options=LOSSLESS)
    at_pictures = tuple(Span(0.48, end) for end in (0.88, 0.92, 1.28, 1.68))  # as they are late
    for span in (Span(1.0), Span(1.01, 1.5), Span(0.0, 1.2), *(at_pictures if "sound" in kind else ())):
        pictures = [round(p.image.mean() / 4) for p in video.read(view, span, lambda _: None)]
        assert [int(p.image[0, -1]) // 4 for p in open_mattes(folder, video, span).read(view, span)] == pictures
        if kind == "later than the sound":
            mattes = open_mattes(as_a_video, video, span)
            read = [*mattes.read(view, span)]
            assert [int(p.image[0, -1]) // 4 for p in read] == pictures
            assert [p.time for p in read] == pytest.approx([n / 25 + 0.08 for n in pictures], abs=2e-3)
            assert "begin at 0.00 s of their file and the video's pictures at 0.08 s" in " ".join(mattes.notes)


def test_a_part_is_not_taken_from_mattes_of_another_rate(tmp_path: Path) -> None:
    masks = [np.dstack([matte()] * 3)] * 18
    video = open_footage(encode(tmp_path / "v.mkv", masks, fps="24000/1001", options=LOSSLESS))
    mattes = encode(tmp_path / "m.mkv", masks, fps=24, options=LOSSLESS)
    with pytest.raises(UserError, match=r"24 pictures a second, the video 23\.98"):
        open_mattes(mattes, video, Span(0.3))
    assert open_mattes(mattes, video).footage.rate == 24


def test_times_that_a_file_rounds_do_not_shift_the_mattes_of_a_part(tmp_path: Path) -> None:
    video = encode(tmp_path / "v.mov", [picture(n % 5) for n in range(18)], fps=30, options=LOSSLESS)
    mattes = encode(tmp_path / "m.mkv", [np.dstack([matte(n % 5)] * 3) for n in range(18)], fps=30, options=LOSSLESS)
    for part in (Span(0.1668, 0.5668), Span(0.1668)):  # behind the sixth picture; before its Matroska milliseconds
        out = tmp_path / f"{part.end}"
        (tmp_path / "head.npz").touch()
        choices = Choices(crop="none", matte=mattes, span=part)
        track(video, out, tmp_path / "head.npz", grid_head(), choices, say=lambda _: None)
        found = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((out / "matte").iterdir())]
        np.testing.assert_array_equal(found, [matte(n % 5) for n in range(6, 18)])


def test_single_mattes_without_the_face_are_named_and_many_refused(video: Path, tmp_path: Path) -> None:
    def without(*numbers: int) -> Write:
        return lambda path, m: cv2.imwrite(str(path), m * 0 if int(path.stem) in numbers else m)

    out, said = tracked(tmp_path, video, as_folder(tmp_path / "m", without(4)))
    (note,) = (line for line in said if "leave out most of the face" in line)
    assert note.endswith("4") and note.removeprefix("note: ") in read_info(out).notes
    (tmp_path / "two").mkdir()
    with pytest.raises(UserError, match="leave out most of the face in 3 of 12 frames"):
        tracked(tmp_path / "two", video, as_folder(tmp_path / "two" / "m", without(4, 7, 8)))


def test_shares_on_the_face() -> None:
    square = np.array([(10, 10), (29, 10), (29, 29), (10, 29)], np.float32)
    mask = np.zeros((40, 40), np.uint8)
    mask[10:30, 10:20] = 255
    assert share_on(square, mask) == (0.5, 0.0)
    assert share_on(square, 255 - mask) == (0.5, 1.0)
    assert share_on(square + 1000, mask) == (200 / 1600, 200 / 1600)  # a face outside the picture
