"""Frames that are transparent where there is no person: their matte is used, whoever wrote them, and that is said."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from exports import write_imavatar, write_insta, write_vhap
from importing import FRAMES, import_folder

from avatar.data.read_image import read_mask
from avatar.data.subject import Subject
from avatar.head.assets import load_head_assets
from data_prep.check.folder import Check, check_tracked_folder

NOTE = "the transparency of the images is taken as the matte"


def soft_matte(head: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(head, (0, 0), 1.0)


def make_transparent(folder: Path, images: str, matte_of: Callable[[Path], np.ndarray], kind: type = np.uint8) -> None:
    """Black under the transparent pixels, as many programs leave it."""
    for path in sorted(folder.glob(images)):
        image, matte = cv2.imread(str(path)), matte_of(path)
        image[matte <= 2] = 0
        scale = kind(np.iinfo(kind).max // 255)
        assert cv2.imwrite(str(path), np.dstack((image, matte)).astype(kind) * scale)


@pytest.fixture
def folder(tracked: Path, tmp_path: Path) -> Path:
    """metrical-tracker's layout without alpha/, its images as they were."""
    folder = Path(shutil.copytree(tracked, tmp_path / "someone"))
    shutil.rmtree(folder / "alpha")
    return folder


def matte_of(folder: Path) -> Callable[[Path], np.ndarray]:
    return lambda path: soft_matte(read_mask(folder / "parsing" / f"{path.stem}_neckhead.png"))


def checked(folder: Path, tracked: Path) -> Check:
    return check_tracked_folder(folder, lambda: load_head_assets(tracked / "head_model"))


def assert_mattes(subject: Subject, expected: Callable[[int], np.ndarray]) -> None:
    for index in range(FRAMES):
        alpha = subject.frame(index).alpha
        torch.testing.assert_close(alpha, torch.from_numpy(expected(index) / 255.0).float(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_transparent_frames_without_alpha_folder(kind: type, folder: Path, tracked: Path, tmp_path: Path) -> None:
    make_transparent(folder, "imgs/*", matte_of(tracked), kind)
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert f"note: there is no alpha/: {NOTE}" in said and f"there is no alpha/: {NOTE}" in subject.manifest.notes
    assert not any("whole image" in line or "composited" in line for line in said)
    names = [Path(record.image).stem for record in subject.manifest.frames]
    assert_mattes(subject, lambda i: matte_of(tracked)(Path(names[i])))
    frame = subject.frame(0)
    assert torch.equal(frame.composite(torch.ones(3))[0, 0], torch.ones(3)), "the background is gone"

    check = checked(folder, tracked)
    assert [one.severity for one in check.findings if NOTE in one.problem] == ["note"]
    assert check.status == 0 and check.clip is not None
    assert all(view.matte is not None and view.matte.covered < 0.5 for view in check.clip.views.values())


def test_without_head_masks_the_transparency_is_the_head_too(folder: Path, tracked: Path, tmp_path: Path) -> None:
    make_transparent(folder, "imgs/*", matte_of(tracked))
    for path in (folder / "parsing").glob("*_neckhead.png"):
        path.unlink()
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert "note: there are no parsing/*_neckhead.png: the foreground matte is taken as the head" in said
    frame = subject.frame(3)
    assert torch.equal(frame.head_mask, (frame.alpha >= 10 / 255).float()) and 0.05 < frame.alpha.mean() < 0.6


def test_one_opaque_frame_among_transparent_ones_is_all_foreground(folder: Path, tracked: Path, tmp_path: Path) -> None:
    """Its luminance is no matte."""
    make_transparent(folder, "imgs/*", matte_of(tracked))
    path = folder / "imgs" / "00005.png"
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    image[..., 3] = 255
    assert cv2.imwrite(str(path), image)
    subject, _ = import_folder(folder, tracked, tmp_path / "out")
    assert (subject.frame(4).alpha == 1).all() and (subject.frame(5).alpha == 0).any()
    clip = checked(folder, tracked).clip
    assert clip is not None and clip.views[5].brightest["alpha"] == 255


def test_opaque_frames_with_an_alpha_channel_have_no_matte(folder: Path, tracked: Path, tmp_path: Path) -> None:
    make_transparent(folder, "imgs/*", lambda path: np.full_like(read_mask(path), 255))
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert "note: there is no alpha/: the whole image is taken as foreground" in said
    assert not any(NOTE in line for line in said) and subject.manifest.frames[0].alpha is None


def test_mattes_of_their_own_come_before_transparency(tracked: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(tracked, tmp_path / "someone"))
    make_transparent(folder, "imgs/*", matte_of(tracked))
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert not any(NOTE in line for line in said)
    assert_mattes(subject, lambda i: read_mask(tracked / "alpha" / f"{i + 1:05d}.png"))


def test_a_hole_in_the_face_is_found_and_a_soft_rim_is_none(folder: Path, tracked: Path) -> None:
    for path in (folder / "parsing").glob("*_neckhead.png"):
        path.unlink()
    make_transparent(folder, "imgs/*", matte_of(tracked))
    assert checked(folder, tracked).status == 0
    path = folder / "imgs" / "00009.png"
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    image[24:32, 28:36, 3] = 0
    assert cv2.imwrite(str(path), image)
    (finding,) = (one for one in checked(folder, tracked).findings if one.check == "matte-holes")
    assert finding.frames == ("00009",)


def test_in_instas_layout_the_transparency_comes_before_the_whole_person(tracked: Path, tmp_path: Path) -> None:
    """matted/ has shoulders too; the images' own transparency is that of the head. Usual there, and not remarked."""
    folder = write_insta(tracked, tmp_path / "insta", matted=True)
    heads = {f"{i:05d}": tracked / "parsing" / f"{i + 1:05d}_neckhead.png" for i in range(FRAMES)}
    make_transparent(folder, "images/*", lambda path: soft_matte(read_mask(heads[path.stem])))
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert not any(NOTE in line for line in said)
    assert_mattes(subject, lambda i: soft_matte(read_mask(heads[subject.manifest.frames[i].name])))


@pytest.mark.parametrize("format", ["VHAP", "IMavatar"])
def test_transparent_frames_in_other_layouts(format: str, tracked: Path, tmp_path: Path) -> None:
    if format == "VHAP":
        folder = write_vhap(tracked, tmp_path / "vhap", masks=False)
        heads = {f"{i:05d}_00": tracked / "parsing" / f"{i + 1:05d}_neckhead.png" for i in range(FRAMES)}
        images, name = "images/*", "fg_masks/"
    else:
        folder = write_imavatar(tracked, tmp_path / "ima")
        shutil.rmtree(folder / "mask")
        heads = {str(i + 1): tracked / "parsing" / f"{i + 1:05d}_neckhead.png" for i in range(FRAMES)}
        images, name = "image/*", "mask/"
    make_transparent(folder, images, lambda path: soft_matte(read_mask(heads[path.stem])))
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert f"note: there is no {name}: {NOTE}" in said
    names = [Path(record.image).stem for record in subject.manifest.frames]
    assert_mattes(subject, lambda i: soft_matte(read_mask(heads[names[i]])))
    check = checked(folder, tracked)
    assert check.status == 0 and any(NOTE in one.problem for one in check.findings), json.dumps(check.to_dict())


def test_the_faintest_matte_that_counts_as_head(folder: Path, tracked: Path, tmp_path: Path) -> None:
    """A JPEG matte is never quite zero: levels below 10 of 255 are noise, those from 10 on are foreground."""
    for path in (folder / "parsing").glob("*_neckhead.png"):
        path.unlink()
    (folder / "alpha").mkdir()
    for path in sorted((folder / "imgs").iterdir()):
        matte = read_mask(tracked / "alpha" / path.name)
        matte[0, :4] = 0, 9, 10, 11
        assert cv2.imwrite(str(folder / "alpha" / path.name), matte)
    subject, _ = import_folder(folder, tracked, tmp_path / "out")
    frame = subject.frame(7)
    assert frame.head_mask[0, :4].tolist() == [0, 0, 1, 1]
    assert frame.alpha[0, :4].mul(255).tolist() == pytest.approx([0, 9, 10, 11]), "and what counts, counts once"
