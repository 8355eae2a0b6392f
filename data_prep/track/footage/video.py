"""A video file of any kind that ffmpeg reads: upright, square pixels, eight bits, with the time of every picture."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from avatar.errors import UserError
from avatar.files.read import open_file
from avatar.files.third_party import sha256_of
from data_prep.ffmpeg import Decoder, Shown, describe, first_picture, rate_of
from data_prep.track.footage.source import (
    LAID_OVER_GREY,
    Box,
    Footage,
    Span,
    TimedPicture,
    View,
    check_size,
    opaque,
    stride,
)
from data_prep.track.footage.tone_mapping import HDR_TRANSFERS, assumed_matrix, tone_filters

_INPUT = re.compile(r"Input #0, (\S+), from")
_STREAM = re.compile(r"Stream #0:(\d+)(?:\[0x[0-9a-f]+\])?(?:\([^)]*\))?: (\w+): (.*)")
_SIZE = re.compile(r", (\d{1,6})x(\d{1,6})\b")
_DURATION = re.compile(r"Duration: (\d+):(\d\d):(\d\d\.\d+)")
_FOCAL = re.compile(r"focal_?length\.?(?:_in_)?_?35_?mm\w*(?:\.?\w+)*\s*: ([\d.]+)", re.IGNORECASE)
_TRANSPARENT = re.compile(r"rgba|bgra|argb|abgr|yuva|gbrap|ya8|ya16|pal8")
_NO_INDEX = {"mpegts", "mpeg"}  # demuxers that guess where a time is: pictures after it are lost, or of another time
_LISTS = {"concat", "hls", "dash", "sdp", "rtsp", "imf"}  # demuxers that open other files
_TEXT = {"tty", "srt", "webvtt", "ass", "lrc", "microdvd"}  # that take any text
_MAX_LISTED_ERRORS = 3
_NEARLY_SQUARE = 0.005  # of a pixel's side: converters round, and to stretch pictures by so little would only blur them
_BESIDE_THE_POINT = ("Error opening input file", "Input #", "ffmpeg version", "Consider increasing")


@dataclass(frozen=True)
class Video(Footage):
    stream: int
    first: Shown
    colour: tuple[str, ...]  # range, matrix, primaries, transfer
    decoder: tuple[str, ...] = ()  # ffmpeg's option, where its own choice loses something

    def read(
        self, view: View, span: Span, complain: Callable[[str], object], every: int | None = None
    ) -> Iterator[TimedPicture]:
        """Raises UserError when the pictures change their size, or when decoding does not get on."""
        is_transparent = bool(_TRANSPARENT.match(self.first.pixel_format)) or bool(self.decoder)
        # Without a known length the file may have no index to seek by; then the pictures before are decoded and left.
        can_seek = self.duration is not None and span.start > 0
        matrix = assumed_matrix(self.colour, self.first.pixel_format, self.height)
        decoder = Decoder(
            self.path,
            self.stream,
            view.width,
            view.height,
            before=["bwdif=mode=send_frame:deint=interlaced"] if self.first.is_interlaced else [],
            filters=[*matrix, *self._geometry(view), *tone_filters(self.colour)],
            channels=4 if is_transparent else 3,
            seek=[*(("-ss", f"{span.start:.6f}") if can_seek else ()), *self.decoder],
        )
        offset = span.start if can_seek else 0.0
        every, inside, last, was_transparent = every or stride(self.rate), -1, -1.0, False
        for n, (shown, pixels) in enumerate(decoder):
            if (shown.width, shown.height) != (self.first.width, self.first.height):
                raise UserError(
                    f"{self.path} changes from {self.first.width}x{self.first.height} to {shown.width}x{shown.height} "
                    f"pixels after {n} pictures; cut it there, or give --start or --end"
                )
            time = offset + (n / (self.rate or 25.0) if shown.time is None else shown.time)
            if span.end is not None and time >= span.end - 1e-6:
                _report_damage(decoder, decoder.heard, complain)
                break
            last = time
            if time < span.start - 1e-6:
                continue
            inside += 1
            if inside % every:
                continue
            was_transparent |= is_transparent and pixels[..., 3].min() < 255
            yield TimedPicture(time, opaque(pixels) if is_transparent else pixels)
        else:
            _report_damage(decoder, decoder.error_count, complain)
            self._report_missing(last, span, complain)
        if was_transparent:
            complain(LAID_OVER_GREY)

    def _report_missing(self, last: float, span: Span, complain: Callable[[str], object]) -> None:
        wanted = min(x for x in (span.end, self.duration, float("inf")) if x is not None)
        if self.duration is not None and wanted - last > max(1.0, 0.02 * wanted) and last >= 0:
            complain(f"the video says that it is {self.duration:.1f} s long, but its pictures end after {last:.1f} s")

    def _geometry(self, view: View) -> list[str]:
        box, (across, down) = view.box, self.first.aspect
        filters = []
        if across != down and across > 0:
            filters.append(f"scale={self.width}:{self.height}:flags=lanczos+accurate_rnd")
        if box != Box(0, 0, self.width, self.height):
            pixels = self.first.pixel_format
            if any(value % 2 for value in box) and pixels.startswith("yuv"):
                # Planes of half the resolution cannot be cut at an odd pixel without shifting the colours.
                filters.append("format=yuva444p10le" if pixels.startswith("yuva") else "format=yuv444p10le")
            filters.append(f"crop={box.width}:{box.height}:{box.x}:{box.y}:exact=1")
        fits = (view.width, view.height) == (box.width, box.height)
        flags = "accurate_rnd+full_chroma_int+full_chroma_inp" + ("" if fits else "+lanczos")
        return [*filters, f"scale={view.width}:{view.height}:flags={flags}", "setsar=1"]

    @cached_property
    def content_hash(self) -> str:
        return sha256_of(self.path)


def _report_damage(decoder: Decoder, count: int, complain: Callable[[str], object]) -> None:
    if count:
        shown = "; ".join(dict.fromkeys(decoder.errors[: min(count, _MAX_LISTED_ERRORS)]))
        complain(f"the video is damaged: ffmpeg complains {count} times ({shown})")


def open_video(path: Path) -> Video:
    """Look into a video file. Raises UserError, with what to do, where no picture can be had from it."""
    _check_file(path)
    said = describe(path)
    container = _INPUT.search(said)
    if container is None:
        raise UserError(_unreadable(path, said))
    kinds = set(container[1].split(","))
    if _LISTS & kinds:
        raise UserError(
            f"{path} is a list of other files ({container[1].strip(',')}), not a video; give the video itself"
        )
    if _TEXT & kinds:
        raise UserError(f"{path} is a text, not a video; give a video of a person")
    streams = [(int(n), kind, rest) for n, kind, rest in _STREAM.findall(said)]
    videos = [(n, rest) for n, kind, rest in streams if kind == "Video" and "(attached pic)" not in rest]
    if not videos and _is_cut_short(path, said):
        raise UserError(_unreadable(path, said))
    if not videos:
        held = sorted({kind.lower() for _, kind, _ in streams}) or ["nothing"]
        cover = " and a cover picture" if any("(attached pic)" in rest for _, _, rest in streams) else ""
        sound = ", ".join(kind for kind in held if kind != "video") or "nothing"
        raise UserError(f"{path} has no pictures: it holds {sound}{cover}; give a video of a person")
    stream, rest = max(videos, key=lambda video: _area(video[1]))
    decoder = ("-c:v", "libvpx-vp9") if re.search(r"alpha_mode\s*: 1", said) and "vp9" in rest else ()
    found = first_picture(path, stream, decoder)
    if found is None:
        raise UserError(f"none of the pictures in {path} can be decoded ({_reason(said)}); export it again as H.264")
    first, colour = found
    width, height = _square_size(first)
    check_size(path, width, height)
    duration, rate = None if _NO_INDEX & kinds else _DURATION.search(said), rate_of(rest)
    focal = _FOCAL.search(said)
    return Video(
        path=path,
        stream=stream,
        width=width,
        height=height,
        rate=rate,
        duration=int(duration[1]) * 3600 + int(duration[2]) * 60 + float(duration[3]) if duration else None,
        equivalent_focal=_plausible_focal(focal[1]) if focal else None,
        notes=tuple(_notes(first, colour, rest, rate, len(videos), (width, height))),
        first=first,
        colour=colour,
        decoder=decoder,
    )


def _check_file(path: Path) -> None:
    try:
        with open_file(path, None) as file:
            if not file.read(1):
                raise UserError(f"{path} is empty; copy or record it again")
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from None


def _unreadable(path: Path, said: str) -> str:
    if _is_cut_short(path, said):
        return (
            f"{path} is cut short: the index at its end is missing, as after an interrupted copy or a recording that was "
            "not finished; copy or export it again"
        )
    return f"{path} is not a video that ffmpeg can read ({_reason(said)}); convert it to .mp4 (H.264) first"


def _is_cut_short(path: Path, said: str) -> bool:
    """Whether it is a file of MP4's kind whose index is missing, wholly or in part."""
    with open_file(path, None) as file:
        head = file.read(64)
    is_of_the_kind = head[4:8] in (b"ftyp", b"mdat", b"wide", b"free")
    return is_of_the_kind and ("moov atom not found" in said or ("Audio:" not in said and "Video:" not in said))


def _reason(said: str) -> str:
    lines = [line.strip() for line in said.splitlines() if line.strip() and not line.startswith("  ")]
    words = [re.sub(r"^(\[[^\]]*\] )+", "", line) for line in lines if "At least one output" not in line]
    words = [word for word in words if not word.startswith(_BESIDE_THE_POINT)]
    return words[-1].rpartition(": ")[2].rstrip(".")[:200] if words else "it says nothing of why"


def _area(rest: str) -> int:
    size = _SIZE.search(rest)
    return int(size[1]) * int(size[2]) if size else 0


def _square_size(first: Shown) -> tuple[int, int]:
    across, down = first.aspect
    if abs(across - down) < _NEARLY_SQUARE * down or not 1 / 4 <= across / down <= 4:
        return first.width, first.height
    if across > down:
        return round(first.width * across / down), first.height
    return first.width, round(first.height * down / across)


def _plausible_focal(text: str) -> float | None:
    value = float(text) if text.replace(".", "", 1).isdigit() else 0.0
    return value if 5 <= value <= 1200 else None


def _notes(
    first: Shown,
    colour: tuple[str, ...],
    rest: str,
    rate: float | None,
    streams: int,
    size: tuple[int, int],
) -> Iterator[str]:
    coded = _SIZE.search(rest)
    if coded and (int(coded[1]), int(coded[2])) == (first.height, first.width) and first.width != first.height:
        yield f"the video is turned upright as its metadata say: {size[0]}x{size[1]} pixels"
    if size != (first.width, first.height):
        yield f"its pixels are not square: {first.width}x{first.height} are shown as {size[0]}x{size[1]}"
    if first.is_interlaced:
        yield "the video is interlaced: its fields are joined"
    if colour[3] in HDR_TRANSFERS:
        yield f"the video is HDR ({HDR_TRANSFERS[colour[3]]}): its colours are tone-mapped to those of a usual screen"
    if streams > 1:
        yield f"the file holds {streams} videos: the largest is used"
    if (every := stride(rate)) > 1 and rate:
        yield f"of {rate:g} pictures a second every {_ordinal(every)} is used, {rate / every:.4g} a second"


def _ordinal(n: int) -> str:
    return {2: "second", 3: "third"}.get(n, f"{n}th")
