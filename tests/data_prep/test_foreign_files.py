"""Folders that were written on other systems and by other programs: they work, or the sentence is true."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from exports import write_imavatar, write_vhap
from importing import FRAMES, import_folder
from PIL import Image
from tracked_folder import write_tracked_folder

from avatar.data.read_image import read_image
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.check.folder import Check, check_tracked_folder
from data_prep.track.footage.picture_folder import open_footage


def checked(folder: Path, head: Path) -> Check:
    return check_tracked_folder(folder, lambda: load_head_assets(head))


def as_on_windows(folder: Path, change: Callable[[str], str]) -> None:
    for listing in folder.rglob("*.json"):
        content = json.loads(listing.read_text())
        for frame in content["frames"]:
            frame |= {key: change(value) for key, value in frame.items() if key.endswith("_path")}
        listing.write_bytes(b"\xef\xbb\xbf" + json.dumps(content, indent=1).replace("\n", "\r\n").encode())


BACKSLASHES: dict[str, Callable[[str], str]] = {
    "all": lambda path: path.replace("/", "\\"),
    "with a dot": lambda path: ".\\" + path.replace("/", "\\"),
    "mixed": lambda path: "./" + path.replace("/", "\\"),
}


@pytest.mark.parametrize("write", [write_vhap, write_imavatar])
@pytest.mark.parametrize("change", BACKSLASHES)
def test_listings_with_backslashes_are_read(
    change: str, write: Callable[[Path, Path], Path], tracked: Path, original: Subject, tmp_path: Path
) -> None:
    folder = write(tracked, tmp_path / "subject")
    as_on_windows(folder, BACKSLASHES[change])
    subject, _ = import_folder(folder, tracked, tmp_path / "out")
    assert len(subject) == FRAMES and (subject.frame(3).image == original.frame(3).image).all()
    if write is write_vhap:
        assert subject.frame(3).alpha.min() == 0  # its mattes are found too


def test_a_file_that_has_a_backslash_in_its_name_is_that_file(tracked: Path, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "subject")
    for path in sorted((folder / "images").iterdir()):
        path.rename(folder / f"images\\{path.name}")
    as_on_windows(folder, BACKSLASHES["all"])
    (folder / "images").rmdir()
    subject, _ = import_folder(folder, tracked, tmp_path / "out")
    assert subject.frame(3).image.shape[2] == 3


@pytest.mark.parametrize("path", ["..\\x.png", "images\\..\\..\\x.png", "\\x.png", "\\\\host\\x.png"])
def test_backslashes_do_not_lead_out_of_the_folder(path: str, tracked: Path, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "subject", divided=False)
    listing = json.loads((folder / "transforms.json").read_text())
    listing["frames"][5]["file_path"] = path
    (folder / "transforms.json").write_text(json.dumps(listing))
    with pytest.raises(UserError, match="which leaves"):
        import_folder(folder, tracked, tmp_path / "out")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-8"])
def test_names_of_expressions_saved_by_an_editor_of_windows_are_read(encoding: str, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", 2)
    text = json.dumps({"names": ["smile", "brow"]}).replace(" ", "\r\n")
    (folder / "head_model" / "expression_names.json").write_bytes(text.encode(encoding))
    assert load_head_assets(folder / "head_model").names.index("brow") == 1


def converted(folder: Path, pattern: str, suffix: str) -> None:
    for path in sorted(folder.glob(pattern)):
        with Image.open(path) as image:
            image.save(path.with_suffix(suffix))
        path.unlink()


@pytest.mark.parametrize("suffix", [".webp", ".bmp", ".tif"])
def test_frames_of_another_format_are_named(suffix: str, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", 6)
    converted(folder, "imgs/*.jpg", suffix)
    with pytest.raises(UserError, match=rf"imgs holds 6 \{suffix} files, .*; convert them to PNG"):
        import_folder(folder, folder, tmp_path / "out")
    errors = [finding for finding in checked(folder, folder / "head_model").findings if finding.severity == "error"]
    assert [finding.check for finding in errors] == ["layout"] and f"6 {suffix} files" in errors[0].problem
    with pytest.raises(UserError, match=rf"holds \{suffix} files; convert them"):
        open_footage(folder / "imgs")


@pytest.mark.parametrize("pattern", ["alpha/*", "parsing/*_neckhead.png", "parsing/*_mouth.png"])
def test_masks_of_another_format_are_not_passed_over(pattern: str, tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", 6)
    converted(folder, pattern, ".webp")
    with pytest.raises(UserError, match=r"holds 6 \.webp files"):
        import_folder(folder, folder, tmp_path / "out")


def test_a_picture_of_another_format_with_a_jpeg_suffix_is_named(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", 6)
    for path in (folder / "imgs").iterdir():
        with Image.open(path) as image:
            image.save(path, "WEBP")
    with pytest.raises(UserError, match=r"is a WebP picture, .*; convert it to PNG"):
        import_folder(folder, folder, tmp_path / "out")
    (finding,) = (f for f in checked(folder, folder / "head_model").findings if f.check == "unreadable")
    assert "WebP" in finding.problem and "convert it to PNG" in finding.advice


def test_a_listing_of_webp_pictures_names_them(tracked: Path, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "subject")
    converted(folder, "images/*.png", ".webp")
    as_on_windows(folder, lambda path: path.replace("images/", "images\\").replace("_00.png", "_00.webp"))
    shutil.rmtree(folder / "fg_masks")
    with pytest.raises(UserError, match=r"00000_00\.webp is a WebP picture"):
        import_folder(folder, tracked, tmp_path / "out")


@pytest.mark.parametrize(
    ("start", "name"),
    [(b"RIFF\0\0\0\0WEBPVP8 ", "WebP"), (b"BM" + bytes(20), "BMP"), (b"II*\0", "TIFF"), (b"GIF89a", "GIF"),
     (b"\0\0\0\x20ftypheic", "HEIC"), (b"\0\0\0\x20ftypavif", "AVIF")],
)  # fmt: skip
def test_formats_are_told_by_their_content(start: bytes, name: str, tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(start)
    with pytest.raises(UserError, match=rf"is a {name} picture"):
        read_image(tmp_path / "x.jpg")
