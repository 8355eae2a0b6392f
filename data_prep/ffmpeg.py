"""The bundled ffmpeg as a decoder: a process of its own that opens one local file and writes raw pictures into a pipe.

The file may be anything. ffmpeg gets no network and no other protocol than `file`, a bound on the size of a picture, and
is ended when it falls silent; here never more than one picture is held.
"""

from __future__ import annotations

import contextlib
import queue
import re
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8

from avatar.errors import UserError

MAX_PIXELS = 2**26  # of one picture: 8192x8192
STALL_SECONDS = 120.0  # the slowest decoder (8K on a busy core) takes one second a picture
THREADS = 2  # each holds pictures of its own
_KEPT_ERRORS = 20
_MAX_SAID = 2**20  # characters of ffmpeg's description of a file
_LEVEL = re.compile(r"^(?:\[[^\]]* @ [^\]]*\] )*\[(error|fatal|panic|warning)\] (.*)")
_PICTURE = re.compile(
    r"n:\s*(?P<n>\d+) pts:\s*\S+ pts_time:\s*(?P<time>\S+).*? fmt:(?P<pixels>\w+).*? sar:(?P<sar>\d+/\d+) "
    r"s:(?P<width>\d+)x(?P<height>\d+) i:(?P<field>\w)"
)
# showinfo writes a line in pieces, and another thread's message may come between the last two, without its level.
_BETWEEN = re.compile(r"(?: iskey:\d type:\S|color_trc:\S+) *(.+)")
_OF_DAMAGE = re.compile(
    "error|invalid|corrupt|damage|missing|fail|unavailable|out of range|no frame|non-existing|could not|overflow|"
    "premature|truncat",
    re.I,
)
_RATE = re.compile(r", ([\d.]+)(k?) (fps|tbr)")
_COUNT = re.compile(rb"^frame=(\d+)$", re.M)
_COLOUR = re.compile(r"color_range:(\S+) color_space:(\S+) color_primaries:(\S+) color_trc:(\S+)")


class Shown(NamedTuple):
    """What ffmpeg says of one decoded picture, upright, before any scaling."""

    time: float | None  # seconds; None where the file has no time stamps
    width: int
    height: int
    pixel_format: str
    aspect: tuple[int, int]  # of one pixel; (0, 1) is unknown and taken as square
    is_interlaced: bool


class Picture(NamedTuple):
    shown: Shown
    pixels: UInt8[np.ndarray, "H W C"]


def executable() -> str:
    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise UserError(f"there is no ffmpeg to read videos with ({error}); install imageio-ffmpeg again") from None


def opening(path: Path) -> list[str]:
    """The options by which ffmpeg opens `path`, and nothing else, as its input."""
    return ["-protocol_whitelist", "file", "-max_pixels", str(MAX_PIXELS), "-threads", str(THREADS), "-i", _url(path)]


def _url(path: Path) -> str:
    return f"file:{path.resolve()}"  # a name may begin with a dash or look like another protocol's


def describe(path: Path) -> str:
    """ffmpeg's description of a file: its container, streams and metadata, with what is wrong with it."""
    command = [executable(), "-hide_banner", "-nostdin", *opening(path)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=STALL_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        raise UserError(f"{path}: ffmpeg does not get to the end of its header; convert it to .mp4 first") from None
    return done.stderr[:_MAX_SAID].decode(errors="replace")


def rate_of(said: str) -> float | None:
    """Pictures a second of the stream in the description."""
    rates = {kind: float(value) * (1000 if kilo else 1) for value, kilo, kind in _RATE.findall(said)}
    rate = rates.get("fps") or rates.get("tbr")
    return rate if rate and rate < 1000 else None


def count_pictures(path: Path, stream: str) -> int:
    """Coded pictures of a stream, which is not decoded; 0 where there are none."""
    counts = ["-map", f"0:{stream}", "-c", "copy", "-f", "null", "-progress", "pipe:1", "-"]
    command = [executable(), "-hide_banner", "-nostdin", "-nostats", *opening(path), *counts]
    try:
        done = subprocess.run(command, capture_output=True, timeout=STALL_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return 0
    return max((int(number) for number in _COUNT.findall(done.stdout)), default=0)


def first_picture(path: Path, stream: int | str, seek: Sequence[str] = ()) -> tuple[Shown, tuple[str, ...]] | None:
    """The first picture that can be decoded of a stream and its (range, space, primaries, transfer); None without one."""
    shows = ["-map", f"0:{stream}", "-frames:v", "1", "-vf", "showinfo=checksum=0", "-f", "null", "-"]
    command = [executable(), "-hide_banner", "-nostdin", "-nostats", *seek, *opening(path), *shows]
    try:
        done = subprocess.run(command, capture_output=True, timeout=STALL_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return None
    said = done.stderr.decode(errors="replace")
    picture, colour = _PICTURE.search(said), _COLOUR.search(said)
    if picture is None:
        return None
    return _shown(picture), colour.groups() if colour else ("unknown",) * 4


def _shown(found: re.Match[str]) -> Shown:
    try:
        time = float(found["time"])
    except ValueError:  # NOPTS
        time = None
    across, down = (int(part) for part in found["sar"].split("/"))
    return Shown(
        time, int(found["width"]), int(found["height"]), found["pixels"], (across, down), found["field"] in "TB"
    )


class Decoder:
    """One run of ffmpeg over one stream. Iterate once; the process ends with the iteration, however that ends.

    `stream` is a number, or "v:0" for the first stream of pictures.
    `filters` come after the place where time and size of a picture are noted; the last must make pictures of
    `width` x `height` pixels. `errors` are ffmpeg's complaints so far, `error_count` how many there were, `heard` how
    many before the picture that was given last: it decodes ahead.
    """

    def __init__(
        self,
        path: Path,
        stream: int | str,
        width: int,
        height: int,
        *,
        before: Sequence[str] = (),
        filters: Sequence[str] = (),
        channels: int = 3,
        seek: Sequence[str] = (),
    ) -> None:
        pixels = {3: "rgb24", 4: "rgba"}[channels]
        chain = ",".join([*before, "showinfo=checksum=0", *filters, f"format={pixels}"])
        raw = ["-map", f"0:{stream}", "-an", "-sn", "-dn", "-vf", chain, "-fps_mode", "passthrough"]
        self.command = [
            *(executable(), "-hide_banner", "-nostdin", "-nostats", "-loglevel", "repeat+level+info"),
            *(*seek, *opening(path), *raw, "-f", "rawvideo", "-pix_fmt", pixels, "-"),
        ]
        self.path = path
        self.shape = height, width, channels
        self.errors: list[str] = []
        self.error_count = self.heard = 0
        self._noted: queue.SimpleQueue[tuple[Shown, int] | None] = queue.SimpleQueue()

    def __iter__(self) -> Iterator[Picture]:
        """Raises UserError when ffmpeg falls silent."""
        process = subprocess.Popen(self.command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0)
        listener = threading.Thread(target=self._listen, args=(process,), daemon=True)
        listener.start()
        try:
            while (pixels := self._within_time(process)) is not None:
                try:
                    noted = self._noted.get(timeout=STALL_SECONDS)
                except queue.Empty:
                    noted = None
                if noted is None:
                    raise UserError(f"{self.path}: ffmpeg gave a picture without saying which; convert the video first")
                shown, self.heard = noted
                yield Picture(shown, pixels)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(STALL_SECONDS)  # its output is closed, and it may still say why it ended there
        finally:
            process.kill()
            process.wait()
            listener.join()
            for pipe in (process.stdout, process.stderr):
                if pipe is not None:
                    pipe.close()

    def _within_time(self, process: subprocess.Popen[bytes]) -> np.ndarray | None:
        """`_read`, with a process that says nothing for too long ended. Raises UserError then."""
        is_late = threading.Event()

        def end() -> None:
            is_late.set()
            process.kill()

        watchdog = threading.Timer(STALL_SECONDS, end)
        watchdog.daemon = True
        watchdog.start()
        try:
            pixels = _read(process, self.shape)
        finally:
            watchdog.cancel()
        if pixels is None and is_late.is_set():
            raise UserError(
                f"{self.path}: decoding does not get on (nothing for {STALL_SECONDS:.0f} s); convert it to H.264 first"
            )
        return pixels

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stderr is not None
        rest = b""
        while chunk := process.stderr.read(2**16):
            *lines, rest = (rest + chunk).split(b"\n")
            rest = rest[-4096:]
            for line in lines:
                self._note(line[:4096].decode(errors="replace"))
        self._noted.put(None)

    def _note(self, line: str) -> None:
        if "Parsed_showinfo" in line:
            if (found := _PICTURE.search(line)) is not None:
                self._noted.put((_shown(found), self.error_count))
            between = _BETWEEN.search(line)
            if between is not None and _OF_DAMAGE.search(between[1]):
                self._complain(between[1])
            return
        said = _LEVEL.match(line)
        if said is not None and said[1] != "warning":
            self._complain(said[2])

    def _complain(self, message: str) -> None:
        self.error_count += 1
        if len(self.errors) < _KEPT_ERRORS:
            self.errors.append(message.strip())


def _read(process: subprocess.Popen[bytes], shape: tuple[int, int, int]) -> np.ndarray | None:
    """The next picture; None at the end, also when the last one is incomplete."""
    assert process.stdout is not None
    pixels = np.empty(shape, np.uint8)
    free = pixels.data.cast("B")
    while len(free):
        count = process.stdout.readinto(free)  # type: ignore[attr-defined]  # unbuffered: one read of the pipe
        if not count:
            return None
        free = free[count:]
    return pixels
