"""Which files a tracked folder holds for which frame number."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar.data.read_image import (
    IMAGE_SUFFIXES,
    OTHER_PICTURES,
    decode_image,
    decode_mask,
    decode_transparency,
    has_transparency,
    read_bytes,
)
from avatar.errors import UserError, refuse

# Kinds of file, by the names that a person knows them by.
IMAGE, ALPHA, HEAD, MOUTH = "imgs", "alpha", "parsing *_neckhead", "parsing *_mouth"
PARSING, TRACKING = "face parsing", "checkpoint"


class KindNames(NamedTuple):
    """Where a layout has its files, for messages."""

    alphas: str = "alpha/"
    head_masks: str = "parsing/*_neckhead.png"
    mouth_masks: str = "parsing/*_mouth.png"
    images: str = "imgs/"
    tracking: str = "checkpoint/"


_NUMBERED_NAMES = KindNames()
_SAMPLES = 8  # images that are looked at for transparency


@dataclass(frozen=True)
class FrameFiles:
    """Files of a tracked folder by frame number; an empty dictionary where the folder has none of a kind."""

    folder: Path
    images: dict[int, Path]
    alphas: dict[int, Path] = field(default_factory=dict)
    head_masks: dict[int, Path] = field(default_factory=dict)
    mouth_masks: dict[int, Path] = field(default_factory=dict)
    tracking: dict[int, Path] = field(default_factory=dict)
    parsing: dict[int, Path] = field(default_factory=dict)  # class maps that stand in for head and mouth masks
    decode_parsing: Callable[[bytes, Path], np.ndarray] = decode_mask  # to the classes of `face_parsing`
    listings: tuple[Path, ...] = ()  # files that say which image and which tracking belong together
    paired_by: str = ""  # what says it, where that is not the first listing
    names: KindNames = _NUMBERED_NAMES
    labels: Mapping[str, int] = field(default_factory=dict)  # kinds of label images, and the value that stands for 255

    @property
    def pairing(self) -> str:
        """What says which image and which tracking belong together; empty where the offset has to be found."""
        return self.paired_by or next((path.name for path in self.listings), "")

    @cached_property
    def is_one_folder(self) -> bool:
        """Whether the images lie in one folder."""
        return len({path.parent for path in self.images.values()}) == 1

    @cached_property
    def is_numbered_by_names(self) -> bool:
        """Whether the images' names hold their numbers, so that numbers which are missing are missing frames."""
        last = ((number, re.findall(r"[0-9]+", path.stem)[-1:]) for number, path in self.images.items())
        return self.is_one_folder and all(digits and int(digits[0]) == number for number, digits in last)

    @cached_property
    def is_transparent(self) -> bool:
        """Whether the images are their own mattes."""
        return any(self.alphas.get(number) == path for number, path in self.images.items())

    def decode(self, kind: str, data: bytes, path: Path) -> np.ndarray:
        """A file of a kind of `of_kind` but the tracking: uint8 [H, W, 3] of an image, [H, W] of a mask, classes of a
        parsing. Raises UserError naming the file."""
        if kind == IMAGE:
            return decode_image(data, path)
        if kind == PARSING:
            return self.decode_parsing(data, path)
        if kind == ALPHA and self.is_transparent:
            return decode_transparency(data, path)
        return decode_mask(data, path, self.labels.get(kind))

    def read(self, kind: str, number: int) -> np.ndarray | None:
        """The file of a frame, decoded; None where the frame has none of the kind. Raises UserError naming the file."""
        path = self.of_kind().get(kind, {}).get(number)
        return None if path is None else self.decode(kind, read_bytes(path), path)

    def of_kind(self) -> dict[str, dict[int, Path]]:
        """By the name that a person knows each kind by."""
        return {
            IMAGE: self.images,
            ALPHA: self.alphas,
            HEAD: self.head_masks,
            MOUTH: self.mouth_masks,
            TRACKING: self.tracking,
        } | ({PARSING: self.parsing} if self.parsing else {})

    def title(self, kind: str) -> str:
        """What the layout itself calls a kind of `of_kind`."""
        own = {
            IMAGE: self.names.images,
            ALPHA: self.names.alphas,
            TRACKING: self.names.tracking,
            PARSING: self.names.head_masks,
        }
        return own.get(kind, kind).rstrip("/")

    def frame_names(self) -> dict[int, str]:
        """The images' stems; with their folders where images lie in several, as the same stem may come twice."""
        if self.is_one_folder:
            return {number: path.stem for number, path in self.images.items()}
        inside = {number: path.relative_to(self.folder) for number, path in self.images.items()}
        return {number: "_".join(path.with_suffix("").parts) for number, path in inside.items()}


def find_frame_files(
    folder: Path, tracking: Path | None = None, complain: Callable[[str], object] = refuse
) -> FrameFiles:
    """List `folder` (imgs/, alpha/, parsing/, checkpoint/) and the tracking folder, if that is another one.

    Raises UserError when there is no folder. Calls `complain`, which raises too by default, when images or tracking are
    missing, a file has no number, two have the same one, or masks are numbered otherwise; if it returns, the listing goes
    on without that file.
    """
    folder = Path(folder)
    if folder.is_file():
        raise UserError(f"{folder} is a file; give the folder that holds imgs/ (the frames of the video)")
    if not folder.is_dir():
        raise UserError(f"the folder {folder} does not exist")
    images = find_numbered(folder / "imgs", complain)
    if not images and not _others(folder / "imgs"):
        complain(f"{folder} has no frames: put them in {folder / 'imgs'} as 00001.jpg, 00002.jpg ... (or .png)")
    files = FrameFiles(
        folder=folder,
        images=images,
        alphas=find_numbered(folder / "alpha", complain) or transparent(images),
        head_masks=find_numbered(folder / "parsing", complain, "_neckhead"),
        mouth_masks=find_numbered(folder / "parsing", complain, "_mouth"),
        tracking=find_tracking(folder, tracking, complain),
    )
    find_shifted_masks(files, complain)
    return files


def find_shifted_masks(files: FrameFiles, complain: Callable[[str], object] = refuse) -> None:
    """Calls `complain` where masks begin and end earlier than the images, or later: a program numbered them anew, and equal
    numbers are hardly of one frame."""
    for kind, masks in ((ALPHA, files.alphas), (HEAD, files.head_masks), (MOUTH, files.mouth_masks)):
        if not files.images or not masks:
            continue
        (first, last), (first_mask, last_mask) = ((min(n), max(n)) for n in (files.images, masks))
        if (first - first_mask) * (last - last_mask) > 0:
            complain(
                f"{files.folder}: {files.title(kind)} has the numbers {first_mask:05d} to {last_mask:05d} and "
                f"{files.title(IMAGE)} {first:05d} to {last:05d}, but a mask has the number of its image; rename the masks"
            )


def transparent(images: Mapping[int, Path]) -> dict[int, Path]:
    """The images as their own mattes, where any of a few is transparent somewhere; else none."""
    for number in list(images)[:: max(1, len(images) // _SAMPLES)]:
        try:
            data = read_bytes(images[number])
            if has_transparency(data) and decode_transparency(data, images[number]).min() < 255:
                return dict(images)
        except UserError:
            continue  # damaged: named when all of them are read
    return {}


def find_tracking(
    folder: Path, given: Path | None = None, complain: Callable[[str], object] = refuse
) -> dict[int, Path]:
    """metrical-tracker's files by number, of `folder` or of the folder that is given; `complain` as above."""
    find = partial(find_numbered, complain=complain, suffixes=(".frame",))
    if given is None:
        found = find(folder / "checkpoint")
        if not found:
            complain(f"{folder / 'checkpoint'} holds no .frame files of metrical-tracker; give --tracking their folder")
        return found
    if not Path(given).is_dir():
        complain(f"the tracking folder {given} does not exist")
        return {}
    found = find(Path(given) / "checkpoint") or find(Path(given))
    if not found:
        complain(f"neither {given} nor {Path(given) / 'checkpoint'} holds .frame files of metrical-tracker")
    return found


def find_numbered(
    folder: Path,
    complain: Callable[[str], object] = refuse,
    tag: str = "",
    suffixes: tuple[str, ...] = IMAGE_SUFFIXES,
) -> dict[int, Path]:
    """Files `<anything><number><tag><suffix>` (any case) by number, in the order of the numbers; `complain` as above."""
    if not folder.is_dir():
        return {}
    found: dict[int, Path] = {}
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda e: e.name):
            stem, suffix = Path(entry.name).stem, Path(entry.name).suffix
            if entry.name.startswith(".") or suffix.lower() not in suffixes or entry.is_dir():
                continue
            if not stem.lower().endswith(tag):
                continue
            digits = re.search(r"([0-9]+)$", stem[: len(stem) - len(tag)])
            if digits is None:
                complain(f"{entry.path} has no frame number at the end of its name; rename or remove it")
                continue
            number = int(digits[1])
            if number in found:
                complain(f"{found[number]} and {entry.path} are both frame {number}; remove one of them")
                continue
            found[number] = Path(entry.path)
    if not found and suffixes == IMAGE_SUFFIXES and (others := _others(folder, tag)):
        complain(
            f"{folder} holds {len(others)} {others[0].suffix} files, and pictures are read as {', '.join(IMAGE_SUFFIXES)}; "
            f"convert them to PNG under the same numbers (ffmpeg -i {others[0].name} {others[0].stem}.png)"
        )
    return dict(sorted(found.items()))


def _others(folder: Path, tag: str = "") -> list[Path]:
    """Pictures of formats that are not read."""
    return sorted(p for p in folder.glob("*") if p.suffix.lower() in OTHER_PICTURES and p.stem.lower().endswith(tag))


def describe_numbers(numbers: list[int], limit: int = 12, name: Callable[[int], str] = "{:05d}".format) -> str:
    """`00003-00005, 00009` for messages; runs are joined, and a long list is cut."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    shown = [name(a) if name(a) == name(b) else f"{name(a)}-{name(b)}" for a, b in runs[:limit]]
    return ", ".join(shown) + (f" and {len(runs) - limit} more" if len(runs) > limit else "")


def gaps(numbers: dict[int, Path]) -> list[int]:
    """Numbers that are missing between the first and the last (at most 10,000 of them)."""
    if not numbers:
        return []
    first, last = min(numbers), max(numbers)
    return [n for n in range(first, min(last, first + 10_000 + len(numbers))) if n not in numbers][:10_000]
