"""Pictures as they come, from a camera or from a video at its own rate. The newest counts: who is slow misses some."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from jaxtyping import UInt8

from avatar.errors import UserError
from data_prep.ffmpeg import STALL_SECONDS
from data_prep.track.faces.detect import quiet
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.source import Footage, Span, View, check_size, whole

LONGEST = 1280  # pixels of a picture; the landmarks come from 256 pixels around the face
SILENT_AFTER = 5.0  # seconds without a picture after which a camera is given up
FOLLOWED = {cv2.CAP_PROP_BUFFERSIZE: 1}  # settings of a camera: old pictures are of no use
FILMED = {  # a camera that does not have this takes what is nearest; without MJPEG many are slow at this size
    cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"MJPG"),
    cv2.CAP_PROP_FRAME_WIDTH: 1280,
    cv2.CAP_PROP_FRAME_HEIGHT: 720,
    cv2.CAP_PROP_FPS: 30,
}


class LivePicture(NamedTuple):
    image: UInt8[np.ndarray, "H W 3"]
    taken: float  # seconds of `time.monotonic`


class Source(Protocol):
    """Something that gives pictures while time passes."""

    @property
    def name(self) -> str: ...
    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures."""
        ...

    @property
    def equivalent_focal(self) -> float | None:
        """Millimetres for film of 36x24 mm, where it is known."""
        ...

    @property
    def silent_after(self) -> float:
        """Seconds without a picture that mean that none will come."""
        ...

    def pictures(self) -> Iterator[LivePicture]:
        """Until the source ends. Raises UserError with the reason where it breaks off."""
        ...

    def close(self) -> None: ...


class Camera:
    """A camera of this machine by its number, through OpenCV. Implements `Source`."""

    silent_after = SILENT_AFTER
    equivalent_focal = None

    def __init__(
        self,
        number: int,
        open_camera: Callable[[int], cv2.VideoCapture] = cv2.VideoCapture,
        settings: Mapping[int, float] = FOLLOWED,
    ) -> None:
        """Raises UserError where there is no such camera, or it gives no picture."""
        self.name = f"camera {number}"
        with quiet():  # OpenCV's back ends write remarks of their own
            self._capture = open_camera(number)
            for setting, value in settings.items():
                self._capture.set(setting, value)
            is_there, first = self._capture.read() if self._capture.isOpened() else (False, None)
        if not is_there or first is None:
            self._capture.release()
            raise UserError(_no_camera(number))
        self.size = first.shape[1], first.shape[0]
        check_size(Path(self.name), *self.size)
        self._is_open, self._is_read = True, False

    def pictures(self) -> Iterator[LivePicture]:
        self._is_read = True
        try:
            while self._is_open:
                is_there, image = self._capture.read()
                taken = time.monotonic()
                if not is_there or image is None or image.shape[:2] != self.size[::-1]:
                    raise UserError(f"{self.name} gives no pictures any more; plug it in again and start anew")
                yield LivePicture(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), taken)
        finally:
            self._capture.release()

    def close(self) -> None:
        self._is_open = False
        if not self._is_read:  # else its reader releases it, after the picture that is being read
            self._capture.release()


def _no_camera(number: int) -> str:
    there = sorted(path.name for path in Path("/dev").glob("video*")) if sys.platform.startswith("linux") else []
    found = f" (there is {', '.join(there)})" if there else ""
    return (
        f"camera {number} gives no picture{found}: it is missing, in use by another program, or this one may not use it; "
        "give another number, or a video"
    )


class VideoFile:
    """A video, or a folder of pictures, at its own rate. Implements `Source`."""

    silent_after = STALL_SECONDS + SILENT_AFTER  # by then the decoder has ended what does not get on

    def __init__(self, footage: Footage, clock: Callable[[], float] = time.monotonic) -> None:
        self._footage, self._clock = footage, clock
        self._view: View = whole(footage.width, footage.height, LONGEST)
        self.name, self.size = str(footage.path), (self._view.width, self._view.height)
        self.equivalent_focal = footage.equivalent_focal
        self._closed = threading.Event()

    def pictures(self) -> Iterator[LivePicture]:
        begin: float | None = None
        complaints: list[str] = []
        for picture in self._footage.read(self._view, Span(), complaints.append):
            now = self._clock()
            begin = now - picture.time if begin is None else begin
            due = begin + picture.time
            if self._closed.wait(max(due - now, 0.0)):
                return
            yield LivePicture(picture.image, max(due, now))  # late where the decoder is: not older than a camera's
        if complaints:
            raise UserError(f"{self.name} has ended: {'; '.join(complaints)}")

    def close(self) -> None:
        self._closed.set()


def open_source(given: str, settings: Mapping[int, float] = FOLLOWED) -> Source:
    """A camera by its number, with OpenCV's settings, or a video. Raises UserError where neither is there."""
    if re.fullmatch("[0-9]{1,3}", given) and not Path(given).exists():
        return Camera(int(given), settings=settings)
    return VideoFile(open_footage(Path(given)))


class Newest:
    """Reads a source in a thread of its own and keeps its newest picture; those that nobody took are `dropped`."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.read = self.dropped = 0
        self._picture: LivePicture | None = None
        self._end: str | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, daemon=True, name="pictures")

    def start(self) -> None:
        self._thread.start()

    def take(self) -> LivePicture:
        """The newest picture that has not been taken yet, waited for. Raises UserError when no more will come."""
        patience = self.source.silent_after
        with self._changed:
            if not self._changed.wait_for(lambda: self._picture is not None or self._end is not None, patience):
                raise UserError(f"{self.source.name} has given no picture for {patience:.0f} s; start anew")
            picture, self._picture = self._picture, None
            if picture is None:
                raise UserError(self._end or "")
            return picture

    def close(self) -> None:
        """Wakes those that wait; a source that hangs is left behind."""
        self.source.close()
        self._finish(f"{self.source.name} is closed")
        if self._thread.is_alive():
            self._thread.join(2)

    def _read(self) -> None:
        end = ""
        try:
            for picture in self.source.pictures():
                with self._changed:
                    self.dropped += self._picture is not None
                    self._picture = picture
                    self.read += 1
                    self._changed.notify_all()
        except UserError as error:
            end = str(error)
        except Exception as error:  # those that wait must hear of it
            end = f"{self.source.name} breaks off ({error})"
        self._finish(end or f"{self.source.name} has ended after {self.read} pictures")

    def _finish(self, end: str) -> None:
        with self._changed:
            self._end = self._end or end
            self._changed.notify_all()
