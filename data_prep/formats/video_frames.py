"""Videos of a data set as image files in the cache: decoded once, and again where a video has changed."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from avatar.errors import UserError
from avatar.files import read
from avatar.files.atomic import temporary_name
from avatar.files.write_image import encode_image
from data_prep.ffmpeg import Decoder, count_pictures, describe, first_picture, rate_of

_STAMP_FILE = "video.json"  # which video, its facts, and which of its pictures
_STREAM = "v:0"
_IS_MP4 = re.compile(r"Input #0, \S*\bmp4\b")  # and no list of other files


class VideoFacts(NamedTuple):
    width: int  # pixels
    height: int
    rate: float | None  # pictures a second
    count: int  # pictures


class WantedVideo(NamedTuple):
    """Pictures of a video, and the folder for them: 00000.png is the first picture of the video."""

    path: Path
    folder: Path
    facts: VideoFacts
    pictures: tuple[int, ...]  # positions in the video, increasing
    is_matte: bool  # its first channel is kept

    def files(self) -> dict[int, Path]:
        return {number: self.folder / f"{number:05d}.png" for number in self.pictures}


def look_into(path: Path, folder: Path) -> VideoFacts:
    """The facts of an .mp4 file, as they are noted in `folder` if its pictures are there.

    Raises UserError where no picture can be had from it.
    """
    read.check_file(path, None)
    noted = _noted(folder)
    if noted is not None and noted[0] == _identity(path):
        return noted[1]
    said = describe(path)
    found = first_picture(path, _STREAM) if _IS_MP4.search(said) else None
    count = count_pictures(path, _STREAM) if found is not None else 0
    if found is None or not count:
        raise UserError(f"{path} is not an .mp4 video that can be read; copy or download it again")
    return VideoFacts(found[0].width, found[0].height, rate_of(said), count)


def decode_videos(root: Path, videos: Sequence[WantedVideo]) -> None:
    """Write the pictures of the videos that are not there yet into their folders, which are below `root`.

    A folder appears under its name when all its pictures are written. Raises UserError for a damaged video, and where the
    disk has too little room.
    """
    missing = [video for video in videos if not _is_current(video)]
    if not missing:
        return
    total = sum(len(video.pictures) for video in missing)
    try:
        root.mkdir(parents=True, exist_ok=True)
        _check_room(root, missing, total)
        with tqdm(total=total, desc="decode", unit="frame", disable=None) as bar:
            for video in missing:
                for _ in _decode(video):
                    bar.update()
    except OSError as error:
        raise UserError(
            f"the pictures of the videos cannot be written to {root} ({error.strerror}); name another cache with "
            "AVATAR_CACHE"
        ) from None


def _check_room(root: Path, videos: Sequence[WantedVideo], total: int) -> None:
    """Say how many bytes the pictures will take: the first picture of each kind and size stands for the others.

    Raises UserError where the disk has not that many.
    """
    sizes: dict[tuple[bool, int, int], int] = {}
    needed = 0
    for video in videos:
        kind = video.is_matte, video.facts.width, video.facts.height
        if kind not in sizes:
            sizes[kind] = len(_png(video, next(_pictures(video))[1]))
        needed += sizes[kind] * len(video.pictures)
    free = shutil.disk_usage(root).free
    sentence = f"{total} pictures of {len(videos)} videos take about {read.shown_size(needed)} in {root}"
    if needed > free:
        raise UserError(f"{sentence}, where {read.shown_size(free)} are free; name another cache with AVATAR_CACHE")
    print(sentence, file=sys.stderr)


def _decode(video: WantedVideo) -> Iterator[None]:
    building = temporary_name(video.folder)
    try:
        building.mkdir(parents=True)
        for number, pixels in _pictures(video):
            (building / f"{number:05d}.png").write_bytes(_png(video, pixels))
            yield
        (building / _STAMP_FILE).write_text(_stamp(video), encoding="utf-8")
        try:
            if video.folder.exists():
                stale = temporary_name(video.folder)
                video.folder.rename(stale)
                shutil.rmtree(stale, ignore_errors=True)
            building.rename(video.folder)
        except OSError:
            if not _is_current(video):  # another process has just written the same
                raise
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _pictures(video: WantedVideo) -> Iterator[tuple[int, np.ndarray]]:
    """The wanted pictures of a video with their positions, RGB. Raises UserError where one cannot be decoded."""
    wanted, size = set(video.pictures), video.facts[:2]
    scale = f"scale={size[0]}:{size[1]}:flags=accurate_rnd+full_chroma_int+full_chroma_inp"
    decoder = Decoder(video.path, _STREAM, *size, filters=[scale])
    for number, (shown, pixels) in enumerate(decoder):
        if (shown.width, shown.height) != size:
            raise UserError(f"{video.path} changes its size at picture {number}; download it again")
        if decoder.error_count:
            break
        if number in wanted:
            wanted.remove(number)
            yield number, pixels
        if not wanted:
            return
    said = f" ({decoder.errors[0]})" if decoder.errors else ""
    raise UserError(f"{video.path} is damaged: picture {min(wanted)} cannot be decoded{said}; download it again")


def _png(video: WantedVideo, pixels: np.ndarray) -> bytes:
    return encode_image(pixels[..., 0] if video.is_matte else pixels)


def _identity(path: Path) -> list[int | str]:
    status = path.stat()
    return [path.name, status.st_size, status.st_mtime_ns]


def _stamp(video: WantedVideo) -> str:
    return json.dumps(
        {"video": _identity(video.path), "facts": video.facts, "pictures": video.pictures}, allow_nan=False
    )


def _noted(folder: Path) -> tuple[list[int | str], VideoFacts, tuple[int, ...]] | None:
    """The video that a folder's pictures are of, its facts, and which pictures; None where that is not known."""
    try:
        raw = read.read_json(folder / _STAMP_FILE)
        return raw["video"], VideoFacts(*raw["facts"]), tuple(raw["pictures"])
    except (UserError, KeyError, TypeError):
        return None


def _is_current(video: WantedVideo) -> bool:
    if _noted(video.folder) != (_identity(video.path), video.facts, video.pictures):
        return False
    there = {path.name for path in video.folder.iterdir()}
    return all(path.name in there for path in video.files().values())
