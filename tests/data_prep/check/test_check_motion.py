"""Tracking that stands still, changes what is one for a clip, lies on its side, or shows a head that is cut off."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from check_findings import new_findings
from folder_damage import FRAMES, Edit, edit_frame, every, set_K
from preparing import prepare_folder
from tracked_folder import write_tracked_folder

from avatar.data.read_image import read_mask
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.check.findings import Finding
from data_prep.check.folder import Check, check_tracked_folder

Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("good") / "subject", FRAMES, suffix=".png", mouth_opening=True)


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "subject"))


def checked(folder: Path) -> Check:
    return check_tracked_folder(folder, lambda: load_head_assets(folder / "head_model"), frame_offset=1)


def found(folder: Path, check: str) -> list[Finding]:
    return [finding for finding in checked(folder).findings if finding.check == check]


def hold(
    *names: str, value: Callable[[np.ndarray], np.ndarray] = lambda first: first, frames: range = range(FRAMES)
) -> Edit:
    """The values of the first of these frames in all of them."""

    def edit(folder: Path) -> None:
        first = torch.load(folder / "checkpoint" / f"{frames[0]:05d}.frame", weights_only=False)
        held = {f"{s}__{k}": value(first[s][k]) for s, k in (name.split("__") for name in names)}
        every(lambda n: edit_frame(n, **held), tuple(frames))(folder)

    return edit


REST = np.array([[1, 0, 0, 0, 1, 0]], np.float32)
STILL: dict[str, tuple[Edit, str, str]] = {
    "expression": (hold("flame__exp"), "warning", "expression is the same in all 24 frames"),
    "jaw": (hold("flame__jaw"), "warning", "jaw is the same in all"),
    "a jaw at rest": (hold("flame__jaw", value=lambda _: REST), "note", "jaw is at rest in all"),
    "gaze": (hold("flame__eyes"), "warning", "gaze is the same in all"),
    "a gaze at rest": (hold("flame__eyes", value=lambda _: np.tile(REST, 2)), "note", "gaze is at rest in all"),
    "eyelids": (hold("flame__eyelids", value=lambda e: e + 0.1), "warning", "eyelids are the same in all"),
    "no eyelids": (hold("flame__eyelids", value=lambda e: e * 0), "note", "eyelids are at rest in all"),
    "pose": (hold("opencv__R", "opencv__t"), "warning", "head pose is the same in all"),
}


@pytest.mark.parametrize("part", STILL)
def test_a_part_that_stands_still_while_others_move_is_told_by_itself(part: str, folder: Path) -> None:
    edit, severity, sentence = STILL[part]
    edit(folder)
    (finding,) = found(folder, "still-part")
    assert finding.severity == severity and sentence in finding.problem


def test_an_expression_that_stood_still_is_said_before_training_too(folder: Path, tmp_path: Path) -> None:
    hold("flame__exp", "flame__jaw")(folder)
    assert [finding.severity for finding in found(folder, "still-part")] == ["warning", "warning"]
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1, ignore_misfit=True)
    assert any("the tracked expression is the same in all 24 frames" in line for line in said)


def test_an_expression_that_is_lost_for_a_while_is_named(folder: Path) -> None:
    hold("flame__exp", frames=range(8, 12))(folder)
    (finding,) = found(folder, "expression-repeats")
    assert finding.severity == "warning" and finding.frames == ("00010", "00011", "00012")


def new_identity(scale: float) -> Callable[[int], Edit]:
    rng = np.random.default_rng(0)

    def edit(number: int) -> Edit:
        noise = np.zeros((1, 300), np.float32)
        noise[0, :3] = scale * rng.normal(0, 1, 3)
        return edit_frame(number, flame__shape=lambda shape: shape + noise)

    return edit


def test_an_identity_that_is_found_anew_in_every_frame_is_an_error(folder: Path, tmp_path: Path) -> None:
    every(new_identity(1.0))(folder)
    (finding,) = found(folder, "identity")
    assert finding.severity == "error" and "mm in the median" in finding.problem
    with pytest.raises(
        UserError, match=r"the identity changes from frame to frame, by .* mm in the median and .* at most"
    ):
        prepare_folder(folder, tmp_path / "out", frame_offset=1)


def test_of_an_identity_that_changes_a_little_the_median_is_used_and_it_is_said(folder: Path, tmp_path: Path) -> None:
    every(new_identity(0.05))(folder)
    shapes = [torch.load(p, weights_only=False)["flame"]["shape"][0] for p in sorted((folder / "checkpoint").iterdir())]
    subject, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    np.testing.assert_allclose(subject.identity.numpy(), np.median(shapes, axis=0), atol=1e-6)
    assert any(line.startswith("note: the identity changes from frame to frame, by 0.") for line in said), said
    (finding,) = found(folder, "tracking-changes")
    assert finding.severity == "warning" and "the median is used" in finding.problem


def test_a_frame_with_another_identity_is_left_out(folder: Path, tmp_path: Path) -> None:
    edit_frame(7, flame__shape=lambda shape: shape + 5)(folder)
    subject, _ = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert subject.manifest.left_out == {"00008": "its identity is more than 2 mm off the clip's"}
    assert [f.frames for f in checked(folder).findings if f.check == "tracking"] == [("00007",)]


def test_a_lens_that_changes_a_little_is_said(folder: Path, tmp_path: Path) -> None:
    edit_frame(8, opencv__K=set_K(0.98))(folder)
    edit_frame(9, opencv__K=set_K(1.01))(folder)
    (finding,) = found(folder, "tracking-changes")
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert finding.severity == "warning" and any(finding.problem in line for line in said)
    assert "the intrinsics change a little within the clip" in finding.problem
    assert "fx goes from 175.62 to 180.99" in finding.problem


def test_several_focal_lengths_in_one_folder_are_an_error_with_their_range(folder: Path, tmp_path: Path) -> None:
    """As where frames of two recordings were put together."""
    for n in range(6, 12):
        edit_frame(n, opencv__K=set_K(1.5 if n < 9 else 2.0))(folder)
    (finding,) = (f for f in checked(folder).findings if "intrinsics change within the clip" in f.problem)
    assert finding.severity == "error" and "fx goes from 179.20 to 358.40" in finding.problem
    with pytest.raises(UserError, match="fx goes from 179.20 to 358.40"):
        prepare_folder(folder, tmp_path / "out", frame_offset=1)


@pytest.mark.parametrize(("degrees", "is_told"), [(90, True), (-90, True), (180, True), (61, True), (45, False)])
def test_a_head_that_lies_is_told(degrees: float, is_told: bool, folder: Path) -> None:
    turn = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(degrees)]))[0].astype(np.float32)
    every(lambda n: edit_frame(n, opencv__R=lambda R: turn @ R, opencv__t=lambda t: t @ turn.T))(folder)
    findings = found(folder, "head-roll")
    assert bool(findings) == is_told
    assert not is_told or ("--rotate" in findings[0].advice and len(findings[0].frames) >= FRAMES // 3)


def crop(folder: Path, top: int = 0, left: int = 0) -> None:
    """Rows and columns cut off all pictures, and the camera with them."""
    for path in [p for kind in ("imgs", "alpha", "parsing") for p in (folder / kind).iterdir()]:
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.parent.name == "imgs" else read_mask(path)
        assert pixels is not None and cv2.imwrite(str(path), pixels[top:, left:])
    moved = np.array([[0, 0, left], [0, 0, top], [0, 0, 0]], np.float32)
    size = np.array([64 - left, 64 - top])
    every(lambda n: edit_frame(n, opencv__K=lambda K: K - moved, img_size=size))(folder)


@pytest.mark.parametrize("cut", [{"top": 20}, {"left": 24}])
def test_a_head_that_is_cut_off_is_told_with_its_share_and_its_frames(
    cut: dict[str, int], folder: Path, tmp_path: Path
) -> None:
    crop(folder, **cut)
    findings = [finding for finding in found(folder, "cut-off") if "tracked head" in finding.problem]
    (finding,) = findings
    assert finding.severity == "warning" and len(finding.frames) == FRAMES
    assert "up to " in finding.problem and "%" in finding.problem
    facts = checked(folder).to_dict()["facts"]
    assert float(facts["head outside the picture, median"].rstrip("%")) > 3
    _, said = prepare_folder(folder, tmp_path / "out", frame_offset=1, ignore_misfit=True)
    assert any("of the tracked head lies outside the pictures" in line for line in said)


def test_hair_at_the_upper_edge_is_told(folder: Path) -> None:
    for path in (folder / "parsing").glob("*_neckhead.png"):
        mask = read_mask(path)
        mask[:20, 24:40] = 255
        cv2.imwrite(str(path), mask)
        cv2.imwrite(str(folder / "alpha" / path.name.replace("_neckhead", "")), mask)
    (finding,) = found(folder, "cut-off")
    assert finding.severity == "warning" and "25% of the upper edge" in finding.problem


def upper_half(path: Path) -> None:
    """The mouth as if it were closed."""
    mask = read_mask(path)
    rows = np.flatnonzero(mask.any(axis=1))
    mask[rows[len(rows) // 2] :] = 0
    cv2.imwrite(str(path), mask)


def test_lips_that_do_not_follow_the_mouth_are_a_warning(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", FRAMES, size=128, suffix=".png")
    paths = sorted((folder / "parsing").glob("*_mouth.png"))
    upper_half(paths[5])
    (finding,) = found(folder, "lips")
    assert finding.severity == "warning" and finding.frames == ("00006",) and "is usual" in finding.problem


def test_lips_below_what_clips_usually_have_are_a_warning(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", FRAMES, size=128, suffix=".png")
    for path in (folder / "parsing").glob("*_mouth.png"):
        cv2.imwrite(str(path), np.roll(read_mask(path), 1, axis=0))
    (finding,) = found(folder, "lips")
    assert finding.severity == "warning" and "in the median" in finding.problem


def test_a_good_folder_has_none_of_these(good: Path) -> None:
    assert new_findings(checked(good)) == {}
