"""CSV files of motion as spreadsheets, phones and trackers write them: read as meant, with the rate said, or refused."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from heads import grid_head

from avatar.errors import UserError
from avatar.head.expression_names import ExpressionNames
from avatar.motion.drive import Drive
from avatar.motion.drive_file import read_drive

ASSETS = grid_head()
NAMES = ExpressionNames(("mouthSmile_L", "mouthSmile_R", "browInnerUp_L", "browInnerUp_R", None))
PHONE = ["Timecode", "BlendShapeCount", "JawOpen", "MouthSmileLeft", "TongueOut", "HeadYaw"]
Rows = list[list[str]]


def code(frame: int, rate: int = 25, start: int = 36_000) -> str:
    seconds = start + frame // rate
    return f"{seconds // 3600 % 24:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}:{frame % rate:02d}.000"


def phone(frames: Sequence[int], rate: int = 25) -> Rows:
    """Line by line; the smile says which frame it is."""
    return [PHONE, *([code(i, rate), "61", "0.250000", f"{i / 1000:.6f}", "0", "0.5"] for i in frames)]


def columns(header: str, rows: Sequence[Sequence[object]]) -> Rows:
    return [header.split(","), *([str(cell) for cell in row] for row in rows)]


def csv(rows: Rows, delimiter: str = ",", end: str = "\n") -> bytes:
    return end.join(delimiter.join(row) for row in [*rows, []]).encode()


def european(rows: Rows) -> Rows:
    return [rows[0], *([row[0], *(cell.replace(".", ",") for cell in row[1:])] for row in rows[1:])]


def read(path: Path, content: bytes, names: ExpressionNames = NAMES) -> tuple[Drive, str]:
    path.write_bytes(content)
    said: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drive = read_drive(path, replace(ASSETS, names=names), 64, said.append)
    return drive, "\n".join(said)


FIFTY = phone(range(50))
FORMATS: dict[str, bytes] = {
    "as recorded": csv(FIFTY),
    "semicolons and decimal commas": csv(european(FIFTY), ";", "\r\n"),
    "tabs": csv(FIFTY, "\t"),
    "tabs and decimal commas": csv(european(FIFTY), "\t"),
    "commas and quoted decimal commas": csv([[f'"{cell}"' for cell in row] for row in european(FIFTY)]),
    "an empty column at the end": csv([[*row, ""] for row in FIFTY]),
    "a comma at the end of the lines alone": csv([FIFTY[0], *([*row, ""] for row in FIFTY[1:])]),
    "a comma at the end of the header alone": csv([[*FIFTY[0], ""], *FIFTY[1:]]),
    "empty lines": csv([FIFTY[0], [], *FIFTY[1:], [""] * 6, []]),
    "empty lines before the names": csv([[], [], *european(FIFTY)], ";"),
    "a byte order mark": b"\xef\xbb\xbf" + csv(FIFTY),
    "UTF-16 of a spreadsheet": csv(FIFTY, "\t").decode().encode("utf-16"),
    "a line that names the separator": b"sep=;\r\n" + csv(european(FIFTY), ";", "\r\n"),
    "a column of row numbers without a name": csv(
        [[str(number) if number else "", *row] for number, row in enumerate(FIFTY)]
    ),
    "names with a program's prefix": csv([["Timecode", *(f"blendShapes.{name}" for name in PHONE[1:])], *FIFTY[1:]]),
    "camel case": csv([[name[0].lower() + name[1:] for name in PHONE], *FIFTY[1:]]),
    "columns of notes in another script": csv([[*FIFTY[0], "备注", "说明"], *([*row, "0", "1"] for row in FIFTY[1:])]),
    "a text column of notes": csv([[*FIFTY[0], "Take"], *([*row, "first take"] for row in FIFTY[1:])]),
}


@pytest.mark.parametrize("form", FORMATS)
def test_a_recording_is_read_as_a_person_means_it(form: str, tmp_path: Path) -> None:
    drive, said = read(tmp_path / "phone.csv", FORMATS[form])
    assert len(drive) == 50 and drive.fps == 25.0
    assert [float(p.expression[0]) for p in drive.params] == pytest.approx([i / 1000 for i in range(50)])
    assert "50 frames, 25 a second" in said and "imecode" in said


RATES: dict[str, tuple[Rows, float, str]] = {
    "less than three seconds": (phone(range(40)), 25.0, "Timecode"),
    "sixty a second": (phone(range(30, 100), 60), 60.0, "Timecode"),
    "thirty a second, across midnight": (
        columns("Timecode,JawOpen", [[code(i, 30, 86_399), 0] for i in range(45)]),
        30.0,
        "Timecode",
    ),
    "every second frame": (phone(range(0, 120, 2), 60), 30.0, "Timecode"),
    "seconds lost": (phone([*range(29), *range(79, 120)]), 25.0, "gaps in its column Timecode, 2.0 s"),
    "single frames lost": (phone([i for i in range(120) if i not in (24, 60, 61)]), 25.0, "Timecode"),
    "frames with parts": (
        columns(
            "Timecode,JawOpen", [[f"1:00:{i // 60:02d}:{i % 60:02d}.{(511 - 3 * i) % 1000:03d}", 0] for i in range(99)]
        ),
        60.0,
        "Timecode",
    ),
    "drop frame": (
        columns("Timecode,JawOpen", [[code(i, 30)[:8] + ";" + code(i, 30)[9:], 0] for i in range(70)]),
        30,
        "Timecode",
    ),
    "a clock": (columns("Timecode,JawOpen", [[f"00:00:{i / 25:06.3f}", 0] for i in range(50)]), 25.0, "Timecode"),
    "a clock that begins with minutes": (
        columns(
            "Timecode,JawOpen",
            [[f"59:{59 + i / 25:06.3f}", 0] for i in range(25)] + [[f"1:00:{i / 25:06.3f}", 0] for i in range(25)],
        ),
        25.0,
        "Timecode",
    ),
    "time in seconds": (
        columns("frame,time,jawOpen", [[i, f"{i / 30:.6f}", 0] for i in range(50)]),
        30.0,
        "time, seconds",
    ),
    "negative times": (columns("time,expression_0", [[(i - 60) / 25, 0] for i in range(50)]), 25.0, "time, seconds"),
    "rounded to milliseconds": (
        columns("time,expression_0", [[f"{i / 30:.3f}", 0] for i in range(99)]),
        30.0,
        "time, seconds",
    ),
    "time in milliseconds": (
        columns("time,expression_0", [[i * 40, 0] for i in range(50)]),
        25.0,
        "time, milliseconds",
    ),
    "time in microseconds": (
        columns("timestamp,expression_0", [[i * 33_333, 0] for i in range(50)]),
        30.0,
        "microseconds",
    ),
    "nanoseconds since 1970": (
        columns("timestamp,expression_0", [[1_700_000_000_000_000_000 + i * 40_000_000, 0] for i in range(50)]),
        25.0,
        "nanoseconds",
    ),
    "a unit in the name": (columns("Time (ms),expression_0", [[i * 500, 0] for i in range(50)]), 2.0, "milliseconds"),
    "two columns of times": (
        columns("timestamp_ms,time,expression_0", [[i * 40, i / 25, 0] for i in range(50)]),
        25.0,
        "timestamp_ms",
    ),
    "no times": (columns("expression_0", [[0]] * 9), 25.0, "assumed"),
    "a phone's without times": (columns("jawOpen,eyeBlinkLeft", [[0, 0]] * 9), 60.0, "assumed"),
    "a single frame": (phone([3]), 60.0, "assumed"),
}


@pytest.mark.parametrize("case", RATES)
def test_the_rate_is_that_of_the_times_and_said(case: str, tmp_path: Path) -> None:
    rows, rate, said_part = RATES[case]
    drive, said = read(tmp_path / "motion.csv", csv(rows))
    assert drive.fps == rate and len(drive) == len(rows) - 1
    assert f" {len(drive)} frames, {drive.fps:g} a second" in said and said_part in said
    assert ("gaps" in said) == (case == "seconds lost")


def times(*values: object) -> Rows:
    return columns("time,expression_0", [[value, 0] for value in values])


REFUSED: dict[str, tuple[bytes, str]] = {
    "a count of frames": (csv(times(*range(50))), "column time rises by 1 a line"),
    "seconds far apart, or milliseconds": (csv(times(*range(0, 9000, 1000))), "column time rises by 1000 a line"),
    "slower than seconds": (
        csv(columns("time_s,expression_0", [[40 * i, 0] for i in range(9)])),
        "column time_s there are 0.025",
    ),
    "less than a second": (csv(phone(range(3, 20))), "column Timecode does not tell"),
    "an unusual number of frames, once": (csv(phone(range(9, 25), 17)), "column Timecode does not tell"),
    "frames that stand still": (csv(columns("Timecode,JawOpen", [["1:00:00:00", 0]] * 9)), "column Timecode"),
    "times that go back": (csv(times(0, 0.04, 0.08, 0.04)), "line 5: time"),
    "times that stand still": (csv(times(*[0, 0, 0.04, 0.04, 0.08, 0.08])), "line 3: time"),
    "half a timecode": (csv(columns("Timecode,JawOpen", [[code(0), 0], ["later", 0]])), "line 3: Timecode is 'later'"),
    "half a clock": (
        csv(columns("Timecode,JawOpen", [["00:00:00.000", 0], ["00:00:00.040", 0], ["later", 0]])),
        "line 4: Timecode is 'later'",
    ),
    "frames beyond those of a second": (
        csv(
            columns(
                "Timecode,JawOpen",
                [[f"0:0:{s}:{i}", 0] for s, n in ((0, 30), (2, 24), (3, 24), (4, 3)) for i in range(n)],
            )
        ),
        "column Timecode does not tell",
    ),
    "columns that disagree": (
        csv(columns("time,timestamp_ms,expression_0", [[i / 25, i * 20, 0] for i in range(9)])),
        "columns time and timestamp_ms give 25 and 50",
    ),
    "times beyond any": (csv(times(-1e308, 0, 1e308)), "time is '-1e+308'"),
    "a time that is none": (csv(times(0, "nan", 0.08)), "line 3: time is 'nan'"),
    "an endless time": (csv(times(0, 0.04, "inf")), "line 4: time is 'inf'"),
    "the first time is none": (csv(times("nan", 0.04, 0.08)), "line 2: time is 'nan'"),
    "times that fall": (csv(times(0.08, 0.04, 0)), "column time must rise"),
    "negative times that fall": (csv(times(0, -0.04, -0.08)), "column time must rise"),
    "times too close": (csv(times(0, 5e-324, 1e-323)), "column time rises by"),
    "times of no length": (
        csv(columns("time_s,expression_0", [[0, 0], [5e-324, 0], [1e-323, 0]])),
        "column time_s there are inf",
    ),
    "timecodes of a thousand digits": (
        csv(columns("Timecode,JawOpen", [["9" * 9000 + ":0:0:1", 0]] * 9)),
        "line 2: Timecode",
    ),
    "coefficients beyond any": (csv(columns("time,jawOpen", [[0, 1e308], [0.04, -1e308]])), "jawOpen is '1e+308'"),
    "percent": (csv(columns("time,jawOpen", [[0, 20], [0.04, 87]])), "jawOpen is '20'"),
    "thousands, or decimals": (
        csv([["time_ms", "expression_0"], ["1,000", "0"], ["1,040", "0"]], ";"),
        "line 2: time_ms is '1,000'",
    ),
    "a value under no name, in a line that is too long": (
        csv([["expression_0"], ["0", "7"]]),
        "line 2: 2 values for 1 columns",
    ),
    "a missing cell": (csv([["expression_0", "expression_1"], [], ["1"]]), "line 3: 1 values for 2 columns"),
    "an empty value": (csv([["expression_0", "expression_1"], ["1", ""]]), "line 2: expression_1 is ''"),
    "no blendshape": (
        csv([["Timecode", "BlendShapeCount", "sound"], [code(0), "61", "0"]]),
        "no column of a blendshape",
    ),
    "the same blendshape twice": (csv([["a.JawOpen", "b.jawOpen"], ["0", "0"]]), "a.JawOpen and b.jawOpen"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_may_mean_two_things_is_refused_with_the_column(case: str, tmp_path: Path) -> None:
    content, part = REFUSED[case]
    with pytest.raises(UserError) as caught:
        read(tmp_path / "bad.csv", content)
    assert part in str(caught.value) and "bad.csv" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("names", "smile", "part"),
    [
        (NAMES, 0.0, None),
        (ExpressionNames(), 0.0, None),  # an audio model moves the jaw alone
        (ExpressionNames(), 0.5, "has no names"),
        (ExpressionNames(("a", "b")), 0.5, "no name of the head model"),
    ],
)
def test_a_head_model_without_names_is_refused_for_what_it_would_lose(
    names: ExpressionNames, smile: float, part: str | None, tmp_path: Path
) -> None:
    header = "Timecode,JawOpen,EyeBlinkLeft,MouthSmileLeft,BrowInnerUp"
    content = csv(columns(header, [[code(i), 0.5, 1, smile, smile] for i in range(50)]))
    if part is None:
        drive, _ = read(tmp_path / "audio.csv", content, names)
        assert drive.params[0].eyelids.tolist() == [1, 0] and float(drive.params[0].jaw[4]) < 1
    else:
        with pytest.raises(UserError, match=part):
            read(tmp_path / "audio.csv", content, names)


@pytest.mark.parametrize("change", [lambda text: text, lambda text: text.replace(b",", b";")])
def test_the_same_motion_whatever_the_separator(change: Callable[[bytes], bytes], tmp_path: Path) -> None:
    content = csv(columns("time,expression_1,jaw_x,jaw_y,jaw_z", [[i / 25, 0.5, 0.1, 0, 0] for i in range(5)]))
    drive, said = read(tmp_path / "own.csv", change(content))
    assert float(drive.params[0].expression[1]) == 0.5 and drive.fps == 25.0 and "left unread" not in said
