"""ffmpeg is held back by its reader, ended with it, and heard to its last word."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from videos import encode

from avatar.errors import UserError
from data_prep import ffmpeg as decoding
from data_prep.track.footage.source import Span, whole
from data_prep.track.footage.video import open_video


def test_only_one_picture_is_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ffmpeg cannot run ahead of a full pipe, and ends when its reader stops."""
    encode(tmp_path / "a.mp4", [np.zeros((480, 640, 3), np.uint8)] * 200)
    video = open_video(tmp_path / "a.mp4")
    begun = []

    class Noted(subprocess.Popen):
        def __init__(self, *args, **options) -> None:
            super().__init__(*args, **options)
            begun.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    pictures = iter(video.read(whole(640, 480), Span(), lambda _: None))
    next(pictures)
    assert [process.poll() for process in begun] == [None]
    pictures.close()  # type: ignore[attr-defined]
    assert begun[0].poll() not in (None, 0)  # ended, and not by itself


def test_a_silent_decoder_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encode(tmp_path / "a.mp4", [np.zeros((64, 64, 3), np.uint8)] * 5)
    decoder = decoding.Decoder(tmp_path / "a.mp4", 0, 64, 64, filters=["scale=64:64", "realtime=speed=0.001"])
    monkeypatch.setattr(decoding, "STALL_SECONDS", 0.5)
    with pytest.raises(UserError, match="decoding does not get on"):
        list(decoder)


def test_a_complaint_after_the_last_picture_is_heard(tmp_path: Path) -> None:
    """The pipe with the pictures ends before the process does."""
    late = "os.close(1); time.sleep(0.3); sys.stderr.write('[matroska @ 0x1] [error] File ended prematurely\\n')"
    decoder = decoding.Decoder(tmp_path / "a.mkv", 0, 8, 8)
    decoder.command = [sys.executable, "-c", f"import os, sys, time; {late}"]
    assert list(decoder) == []
    assert decoder.errors == ["File ended prematurely"] and decoder.error_count == 1


HEARD = ("error while decoding MB 4 3, bytestream -112", "File ended prematurely")


@pytest.mark.parametrize("between", [*HEARD, "Increasing reorder buffer to 2", ""])
def test_a_complaint_between_the_pieces_of_a_line_is_heard(tmp_path: Path, between: str) -> None:
    """showinfo writes its line in two pieces; what another thread says between them comes without its level."""
    shown = (
        "[Parsed_showinfo_0 @ 0x7f] [info] n:  12 pts:     14 pts_time:0.7     duration:      1 "
        "duration_time:0.05    fmt:yuv420p cl:left sar:0/1 s:80x64 i:P iskey:0 type:P "
    )
    decoder = decoding.Decoder(tmp_path / "a.avi", 0, 8, 8)
    says = f"sys.stderr.write({shown + between!r} + chr(10) + chr(10)); sys.stdout.write('x' * 192)"
    decoder.command = [sys.executable, "-c", f"import sys; {says}"]
    assert [(picture.shown.time, picture.shown.width) for picture in decoder] == [(0.7, 80)]
    assert decoder.errors == [said for said in HEARD if said == between] and decoder.error_count == len(decoder.errors)
