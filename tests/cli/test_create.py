"""avatar create with a tracker that copies a folder: what is missing, the plan, the stop, and going on after a kill."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from select import select
from typing import Any

import numpy as np
import pytest
from command_line import avatar
from small_runs import SMALL

from avatar.commands import create
from avatar.commands.arguments import parse
from avatar.config import Config
from avatar.data.source import Source
from avatar.files.third_party import FOLDER_VARIABLE
from avatar.files.video import video_writer
from avatar.pipeline.refine_plan import Plan
from data_prep.formats.avatar_track import TrackingInfo
from data_prep.prepare.open_subject import HEAD_VARIABLE
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.quality import Figure

FRAMES = 30
GOOD = Figure("jitter, against the landmarks' own", 0.5, "x", 1.0, 1.2, "a steadier camera and more light")
POOR = Figure("frames with a face", 50.0, "%", 99, 90, "light the face", True)
POOR_PART = Figure("  of the lips", 3.0, "% eyes", 1.0, 2.0)


def install_small(patch: pytest.MonkeyPatch, tracked: Path, *figures: Figure) -> None:
    """Nothing is missing, the tracking is a copy of `tracked` with these figures, and trainings are SMALL."""
    quality = {"figures": [figure.to_json() for figure in figures]}

    def copied(video: Path, out: Path, *_: Any, **__: Any) -> TrackingInfo:
        if not out.exists():
            growing = out.with_name("growing")
            shutil.rmtree(growing, ignore_errors=True)
            shutil.copytree(tracked, growing)
            growing.rename(out)
        return TrackingInfo(25.0, 48, 48, (1.0,) * 4, "", False, "", "", {}, quality=quality)

    patch.setattr(create, "track", copied)
    patch.setattr(create, "tracking_lacks", lambda *_: [])
    patch.setattr(create, "parse", lambda words: parse([*words, *SMALL]))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "me.mp4")


def write_video(path: Path) -> Path:
    with video_writer(path, 25) as add:
        for level in range(FRAMES):
            add(np.full((64, 64, 3), level, np.uint8))
    return path


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tracked_folder: Path) -> Callable[..., None]:
    return lambda *figures: install_small(monkeypatch, tracked_folder, *figures)


def test_all_that_is_missing_is_said_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path))
    monkeypatch.setenv(HEAD_VARIABLE, "")
    out = tmp_path / "out"
    said = avatar("create", tmp_path / "me.mp4", "--out", out, status=1)
    for part in ("me.mp4 does not exist", "https://flame.is.tue.mpg.de", "face_landmarker.task", "selfie_segmentation"):
        assert part in said
    assert "avatar models --download" in said and not out.exists()


def test_a_file_that_is_no_video_is_among_what_is_missing(tmp_path: Path) -> None:
    text = tmp_path / "me.txt"
    text.write_text("not a video\n" * 20)
    said = avatar("create", text, "--head", tmp_path / "flame", "--out", tmp_path / "out", status=1)
    assert str(text) in said and "flame" in said and "nothing was begun" in said


def test_a_folder_of_pictures_does_not_stand_in_its_own_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "me").mkdir()
    for folder in ("me", "me/", tmp_path / "me"):
        said = avatar("create", folder, "--head", "flame", status=1)
        assert "me" in said and "nothing was begun" in said and "overwritten" not in said


def test_one_command_makes_the_page_and_again_does_nothing_twice(
    small: Callable[..., None], video: Path, tracked_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small(GOOD, POOR)
    monkeypatch.chdir(video.parent)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("avatar.commands.create.sys.platform", "linux")
    words = ("create", video, "--head", tracked_folder / "head_model", "--refine", 0)
    stopped = avatar(*words, status=1)
    assert f"Plan         about {FRAMES} frames" in stopped and "Memory       about" in stopped
    assert "Stage 2 of 4" in stopped and "Stage 3" not in stopped and "1 good, 0 fair, 1 poor of 2 figures" in stopped
    assert "frames with a face: 50 % -> light the face" in stopped and "--anyway" in stopped
    output = avatar(*words, "--anyway", "--open")
    assert "avatar check me/subject shows warnings" in output
    page = video.parent / "me" / "avatar.html"
    assert "poor: frames with a face: 50 %" in output and "There is no desktop here" in output
    assert "Stage 4 of 4" in output and "Done in" in output and "Round" not in output
    assert "avatar view me/run" in output and "avatar reenact me/run" in output and "Held-out frames: PSNR" in output
    first = page.read_bytes()
    assert b"<title>me" in first
    figures = (page.parent / "run" / "eval" / "results.json").stat().st_mtime_ns
    monkeypatch.setattr("avatar.commands.held_out_figures.evaluate", None)  # it is not called
    again = avatar("create", video, "--head", tracked_folder / "head_model", "--anyway")
    assert "is complete (12 steps)" in again and page.read_bytes() == first
    assert (page.parent / "run" / "eval" / "results.json").stat().st_mtime_ns == figures
    assert "began without --refine" in avatar(*words[:-1], 1, "--anyway", status=1)


def test_a_part_of_a_figure_is_named_whole(capsys: pytest.CaptureFixture[str]) -> None:
    info = TrackingInfo(25.0, 4, 4, (1.0,) * 4, "", False, "", "", {}, quality={"figures": [POOR_PART.to_json()]})
    create.judge_tracking(info, Path("subject"), anyway=True)
    assert "poor: landmark error of the lips: 3 % eyes\n" in capsys.readouterr().out


def test_mistakes_are_found_before_anything_is_tracked(
    small: Callable[..., None], video: Path, tracked_folder: Path
) -> None:
    small(GOOD)
    out, words = video.parent / "out", ("create", video, "--head", tracked_folder / "head_model", "--out")
    assert "--refine must be" in avatar(*words, out, "--refine", 11, status=1)
    assert "size" in avatar(*words, out, "--size", 2, status=1)
    assert "device" in avatar(*words, out, "--device", "tpu", status=1)
    assert not out.exists()
    assert "is a file" in avatar(*words, video, status=1)
    (out / "run").mkdir(parents=True)
    assert f"{out / 'subject'}, on which" in avatar(*words, out, status=1)


def test_a_folder_of_another_video_is_refused(
    small: Callable[..., None], video: Path, tracked_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the tracker itself, which knows what its folder was made from."""
    real = create.track
    small(GOOD)
    monkeypatch.setattr(create, "track", real)
    shutil.copytree(tracked_folder, subject := video.parent / "me" / "subject")
    words = ("create", video, "--head", tracked_folder / "head_model", "--out", subject.parent)
    assert f"{subject} exists and is not this tracking" in avatar(*words, status=1)


def test_the_page_is_shown_where_there_is_a_desktop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("webbrowser.open", shown.append)
    create.show(tmp_path / "avatar.html")
    assert shown == [(tmp_path / "avatar.html").as_uri()]


def test_frames_are_counted_as_they_are_tracked(video: Path) -> None:
    footage = open_footage(video)
    assert create.count_frames(footage) == FRAMES
    assert create.count_frames(replace(footage, rate=60.0, duration=10.0)) == 300, "every second one"
    assert create.count_frames(replace(footage, duration=None)) == create.count_frames(replace(footage, duration=1e4))


def test_the_minutes_count_every_part() -> None:
    config = Config()
    alone = create.training_seconds(config, 0, 1000, 800, "cpu")
    assert alone == pytest.approx(99.0)  # docs/train.md, 4,000 steps
    assert create.training_seconds(config, 1, 1000, 800, "cpu") == pytest.approx(99 / 4000 * 5000 + 79)
    assert create.training_seconds(config, 0, 100, 80, "cpu") == pytest.approx(99 / 4000 * 800), "ten passes"
    assert create.training_seconds(config, 0, 1000, 800, "cuda") < alone


def test_a_folder_that_has_moved_is_measured_where_it_is_now(
    small: Callable[..., None], video: Path, tracked_folder: Path
) -> None:
    small(GOOD)
    words, moved = ("create", video, "--head", tracked_folder / "head_model", "--refine", 0), video.parent / "moved"
    avatar(*words, "--out", video.parent / "me")
    (video.parent / "me").rename(moved)
    (moved / "avatar.html").unlink()
    assert "Done in" in avatar(*words, "--out", moved) and (moved / "avatar.html").is_file()


def test_the_minutes_of_a_command_that_goes_on_count_the_rounds_that_it_began_with(tmp_path: Path) -> None:
    subject, run, arguments = tmp_path / "subject", tmp_path / "run", parse(["create", "me.mp4"])
    assert create.training_arguments(arguments, subject, run).refine == create.ROUNDS
    Plan(2, Source(subject, tmp_path), (), None, 100, 50).save(run)
    again = create.training_arguments(arguments, subject, run)
    assert again.refine == 2 and again.resume


# For each line, a folder: a process that makes it, its number and how it ended. It has imported all before.
SCRIPT = f"""
import os, sys
sys.path[:0] = {[str(Path(__file__).parent), str(Path(__file__).parents[1] / "helpers")]!r}
from pathlib import Path
import pytest, torch._dynamo
from test_create import GOOD, install_small
from avatar.cli import main
tracked, video = Path(sys.argv[1]), sys.argv[2]
install_small(pytest.MonkeyPatch(), tracked, GOOD)
for line in sys.stdin:
    if not (child := os.fork()):
        os.dup2(2, 1)
        sys.exit(main(["create", video, "--head", str(tracked / "head_model"), "--out", line.strip()]))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
# What a command has written when it is killed, in this order.
MOMENTS = (
    *("growing/imgs", "subject", "run/rounds/plan.json", "run/rounds/1/run/checkpoints/*"),
    *("run/rounds/1/subject/tracking.npz", "run/run.json", "run/checkpoints/*", "run/avatar.safetensors"),
    *("run/eval/*.mp4", "run/eval/results.json"),
)


@pytest.mark.slow
def test_killed_again_and_again_it_makes_the_same_page(video: Path, tracked_folder: Path) -> None:
    out, whole, log = video.parent / "killed" / "me", video.parent / "whole" / "me", video.parent / "log.txt"
    command = [sys.executable, "-c", SCRIPT, str(tracked_folder), str(video)]
    with (
        log.open("w") as said,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, bufsize=0) as starter,
    ):
        assert starter.stdin and starter.stdout

        def begin(folder: Path) -> int:
            starter.stdin.write(f"{folder}\n".encode())
            return int(starter.stdout.readline())

        killed = 0
        for moment in MOMENTS:
            if any(out.glob(moment)):
                continue  # the last one got so far
            process = begin(out)
            while not any(out.glob(moment)) and not select([starter.stdout], [], [], 0.001)[0]:
                pass
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            status = int(starter.stdout.readline())
            killed += status == -signal.SIGKILL
            assert status in (0, -signal.SIGKILL), log.read_text()
        assert killed >= 6
        for folder in (out, whole):
            begin(folder)
            assert int(starter.stdout.readline()) == 0, log.read_text()
        starter.stdin.close()
    assert (out / "avatar.html").read_bytes() == (whole / "avatar.html").read_bytes()
