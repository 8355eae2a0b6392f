"""Frames that cannot be used: left out and named, up to the share that a person allows."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from folder_damage import FRAMES, all_zero, cut, every, remove
from preparing import edit, prepare_folder
from tracked_folder import write_tracked_folder

from avatar.cli import main
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.check.folder import check_tracked_folder
from data_prep.formats.frame_files import FrameFiles
from data_prep.prepare.pairing import TooManyLeftOut, _refuse_if_unpaired


@pytest.fixture
def two_bad(tmp_path: Path) -> Path:
    """24 frames; the tracker found no face in two of them."""
    folder = write_tracked_folder(tmp_path / "subject", FRAMES)
    for number in (5, 9):
        all_zero(number)(folder)
    return folder


@pytest.mark.parametrize("kind", ["no face", "not finite", "repeated", "cut short", "image cut short", "no mouth mask"])
def test_one_bad_frame_is_left_out_with_a_warning(kind: str, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=24)
    file = folder / "checkpoint" / "00010.frame"
    if kind == "no face":
        edit(file, "opencv", R=np.zeros((1, 3, 3)), t=np.zeros((1, 3)))
        reason = "all zero: the tracker found no face"
    elif kind == "not finite":
        edit(file, "flame", exp=np.full((1, 10), np.inf))
        reason = "flame.exp is not finite (10 of 10 values)"
    elif kind == "repeated":
        before = torch.load(folder / "checkpoint" / "00009.frame", weights_only=False)
        torch.save(before | {"frame_id": "00010"}, file)
        reason = "the tracking repeats that of the frame before, while the image does not"
    elif kind == "cut short":
        file.write_bytes(file.read_bytes()[:400])
        reason = "is damaged or cut short (File is not a zip file); write or copy it again"
    elif kind == "image cut short":
        image = folder / "imgs" / "00011.jpg"
        image.write_bytes(image.read_bytes()[:300])
        reason = f"{image} is cut short; write or copy it again"
    else:
        (folder / "parsing" / "00011_mouth.png").unlink()
        reason = "it has no mouth mask"
    subject, said = prepare_folder(folder, tmp_path / "out")
    assert subject.manifest.left_out == {"00011": reason}
    assert f"warning: left out 1 of 24 frames: 00011 ({reason})" in said
    assert [f.name for f in subject.manifest.frames] == [f"{n:05d}" for n in range(1, 25) if n != 11]
    np.testing.assert_array_equal(
        subject.params(10).expression,
        torch.load(folder / "checkpoint" / "00011.frame", weights_only=False)["flame"]["exp"][0],
    )
    assert (len(subject.split.train), len(subject.split.test)) == (18, 5)


def test_a_still_video_may_repeat_its_tracking(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=24)
    before = torch.load(folder / "checkpoint" / "00009.frame", weights_only=False)
    torch.save(before | {"frame_id": "00010"}, folder / "checkpoint" / "00010.frame")
    shutil.copy(folder / "imgs" / "00010.jpg", folder / "imgs" / "00011.jpg")
    subject, _ = prepare_folder(folder, tmp_path / "out")
    assert subject.manifest.left_out == {}


def test_gaps_and_odd_counts_are_named(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=24)
    (folder / "imgs" / "00013.jpg").unlink()
    subject, said = prepare_folder(folder, tmp_path / "out")
    assert [line.removeprefix("note: ") for line in said if line.startswith("note: ")] == [
        "imgs skips the numbers 00013",
        "alpha has 24 files for 23 images",
        "parsing *_neckhead has 24 files for 23 images",
        "parsing *_mouth has 24 files for 23 images",
        "there are 23 images and 24 tracking frames",
    ]
    assert len(subject) == 23 and subject.manifest.frames[12].tracking == 13


def test_a_person_can_allow_more(two_bad: Path, tmp_path: Path) -> None:
    refused = r"2 of 24 tracking files cannot be used, more than 5%: 00005, 00009 .*allow more with --max-left-out$"
    with pytest.raises(UserError, match=refused):
        prepare_folder(two_bad, tmp_path / "out")
    with pytest.raises(UserError, match=r"2 of 24 .*, more than 8%: "):
        prepare_folder(two_bad, tmp_path / "out", max_left_out=0.08)
    subject, said = prepare_folder(two_bad, tmp_path / "out", max_left_out=0.1)
    assert list(subject.manifest.left_out) == ["00006", "00010"] and len(subject) == 22
    assert any(line.startswith("warning: left out 2 of 24 frames: 00006, 00010 (all zero") for line in said)


def test_the_allowance_covers_frames_without_partner(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", FRAMES)
    remove("checkpoint/0001*.frame")(folder)
    sentence = r"10 of 24 images have no partner .*are they of the same video\? If so, allow more with --max-left-out"
    with pytest.raises(UserError, match=sentence):
        prepare_folder(folder, tmp_path / "out", frame_offset=1)
    subject, _ = prepare_folder(folder, tmp_path / "out", frame_offset=1, max_left_out=0.5)
    assert len(subject) == 14


def test_check_counts_by_the_same_allowance(two_bad: Path) -> None:
    cut("imgs/00014.jpg")(two_bad)

    def found(share: float) -> dict[str, tuple[str, str]]:
        check = check_tracked_folder(
            two_bad, lambda: load_head_assets(two_bad / "head_model"), frame_offset=1, max_left_out=share
        )
        return {one.check: (one.severity, one.problem + "; " + one.advice) for one in check.findings}

    assert found(0.05)["no-face"][0] == "error" and found(0.05)["unreadable"][0] == "warning"
    some = found(0.1)
    assert some["no-face"][0] == "warning" and some["left-out"][0] == "error"
    assert some["left-out"][1].startswith("3 of 24 frames cannot be used, more than 10%: 00006, 00010 (all zero")
    assert some["left-out"][1].endswith(
        "; mend what is named, or train without these frames: --max-left-out allows more"
    )
    assert found(0.13)["no-face"][0] == "warning" and "left-out" not in found(0.13)


def test_the_commands_take_the_allowance(two_bad: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["prepare", str(two_bad), "--out", str(tmp_path / "out"), "--max-left-out"]
    assert main([*command, "0.05"]) == 1
    assert "allow more with --max-left-out" in capsys.readouterr().err
    assert main([*command, "0.1"]) == 0
    assert "22 frames of 64x64" in capsys.readouterr().out
    assert main(["check", str(two_bad), "--frame-offset", "1"]) == 2
    assert main(["check", str(two_bad), "--frame-offset", "1", "--max-left-out", "0.1"]) == 1
    for share in ("-0.1", "1.5", "nan"):
        assert main([*command[:-1], f"--max-left-out={share}"]) == 1
        assert "--max-left-out must be from 0 to 1, not " in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["tracking", "images", "both, each for a half"])
def test_all_frames_may_be_bad_and_there_is_still_a_sentence(kind: str, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", FRAMES)
    if kind == "tracking":
        every(all_zero)(folder)
        sentence = r"no frame has tracking that can be used: 00000-00023 \(all zero: the tracker found no face\); track"
    elif kind == "images":
        cut("imgs/*.jpg")(folder)
        sentence = r"none of the 24 images in .*imgs can be read"
    else:
        every(all_zero, range(12))(folder)
        cut("imgs/0001[3-9].jpg")(folder)
        cut("imgs/0002*.jpg")(folder)
        sentence = r"the subject has 0 usable frame\(s\); at least 2 are needed"
    with pytest.raises(UserError, match=sentence):
        prepare_folder(folder, tmp_path / "out", frame_offset=1, max_left_out=1.0)


@pytest.mark.parametrize(("frames", "share", "most"), [(24, 0.05, 4), (24, 0.5, 12), (200, 0.05, 10)])
def test_a_few_frames_at_the_ends_may_be_without_partner(frames: int, share: float, most: int) -> None:
    numbered = {number: Path(f"{number}.png") for number in range(frames)}
    for kinds in ({"images": numbered, "tracking": {0: Path()}}, {"images": {0: Path()}, "tracking": numbered}):
        files = FrameFiles(Path(), **kinds)
        _refuse_if_unpaired(files, frames - most, 1, share)
        with pytest.raises(TooManyLeftOut, match=f"{most + 1} of {frames} .* have no partner under offset 1"):
            _refuse_if_unpaired(files, frames - most - 1, 1, share)
