"""Folders of pictures in place of videos."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from videos import ffmpeg

from avatar.errors import UserError
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.source import Span, whole


def read(path: Path, span: Span | None = None) -> tuple[list, list[str]]:
    footage, said = open_footage(path), []
    return list(footage.read(whole(footage.width, footage.height), span or Span(), said.append)), said


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_transparent_pictures_lie_over_grey(kind: type, tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    image = np.full((64, 64, 4), (200, 40, 40, 255), np.uint8)
    image[:32, :, 3] = 0
    scale = kind(np.iinfo(kind).max // 255)
    cv2.imwrite(str(folder / "0.png"), cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA).astype(kind) * scale)
    pictures, said = read(folder)
    assert said == ["the pictures are transparent in parts: they are laid over grey"]
    assert (pictures[0].image[:32] == 127).all() and (pictures[0].image[32:] == (200, 40, 40)).all()


def test_transparent_pictures_are_turned_as_their_exif_says(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter clockwise
    image = np.full((64, 80, 4), (200, 40, 40, 255), np.uint8)
    image[:, :40, 3] = 0
    Image.fromarray(image).save(folder / "0.png", exif=exif)
    (picture,), _ = read(folder)
    assert (picture.image[:40] == 127).all() and (picture.image[40:] == (200, 40, 40)).all()


def test_a_folder_of_pictures(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    for n in range(12):
        ffmpeg("-f", "lavfi", "-i", f"color=c=0x{8 * n:02x}{8 * n:02x}{8 * n:02x}:s=64x80:d=0.04", "-frames:v", "1",
               folder / f"{n}.png")  # fmt: skip
    footage = open_footage(folder)
    assert footage.notes == ("a folder of pictures has no frame rate: 25 a second are assumed",)
    pictures, _ = read(folder, span=Span(0.08, 0.44))
    assert [p.time for p in pictures] == pytest.approx([n / 25 for n in range(2, 11)])
    assert [p.image.mean() for p in pictures] == pytest.approx([8 * n for n in range(2, 11)], abs=1)  # 10 after 9
    ffmpeg("-f", "lavfi", "-i", "color=s=64x64:d=0.04", "-frames:v", "1", "-y", folder / "5.png")
    with pytest.raises(UserError, match="5.png is 64x64 pixels but 0.png is 64x80; give pictures of one size"):
        read(folder)
    with pytest.raises(UserError, match="holds no PNG or JPEG pictures"):
        open_footage(tmp_path)
    (tmp_path / "imgs").mkdir()
    with pytest.raises(UserError, match="looks like a tracked folder: give .*imgs to track its pictures again"):
        open_footage(tmp_path)
