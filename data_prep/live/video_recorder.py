"""A camera's pictures written into a video of constant rate, each at the time at which it was taken."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import UInt8

from data_prep.live.picture_sources import LivePicture, Source

WARM_UP = 2.0  # seconds of pictures that the rate is measured on
FEWEST = 8  # pictures for it
SLACK = 0.75  # frames that a picture may be early or late; more than half, so that a camera's jitter moves nothing
COMMON = (5, 7.5, 10, 12.5, 15, 20, 24, 25, 30, 50, 60, 120)  # pictures a second
_NEAR = 0.04  # relative, to a common rate


class VideoRecorder:
    """A source whose pictures also go into a video, between `begin` and `end`. Implements `Source`.

    `pictures` runs in a thread of its own, the rest in another. Of a video at `rate` frames a second, a picture becomes
    the frame nearest to its time: those of a camera that skips are repeated, those that come too early left out.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.name, self.size = source.name, source.size
        self.equivalent_focal, self.silent_after = source.equivalent_focal, source.silent_after
        self._lock = threading.Lock()
        self._waiting: deque[float] = deque()  # times of the last pictures that were not filmed
        self._add: Callable[[UInt8[np.ndarray, "H W C"]], None] | None = None
        self._first: float | None = None
        self.rate = 0.0
        self.frames = self.repeated = self.left_out = 0

    def pictures(self) -> Iterator[LivePicture]:
        """Those of the source; raises what it raises, and UserError where the video cannot be written."""
        last: LivePicture | None = None
        for picture in self._source.pictures():
            with self._lock:
                self._place(picture, last or picture)
            last = picture
            yield picture

    def close(self) -> None:
        self._source.close()

    def measured_rate(self) -> float | None:
        """The camera's pictures a second, a common rate where it is near one; None before `WARM_UP`."""
        with self._lock:
            times = list(self._waiting)
        if len(times) < FEWEST or times[-1] - times[0] < WARM_UP:
            return None
        gaps = np.sort(np.diff(times))
        cut = len(gaps) // 10
        rate = 1.0 / float(gaps[cut : len(gaps) - cut].mean())
        nearest = min(COMMON, key=lambda common: abs(common - rate))
        return nearest if abs(nearest - rate) < _NEAR * rate else round(rate, 1)

    def begin(self, add: Callable[[UInt8[np.ndarray, "H W C"]], None], rate: float) -> None:
        """The next picture is the first frame; `add` writes one."""
        with self._lock:
            self.rate, self._add = rate, add

    def end(self) -> None:
        """No frame is added after this."""
        with self._lock:
            self._add = None

    def _place(self, picture: LivePicture, last: LivePicture) -> None:
        if self._add is None:
            self._waiting.append(picture.taken)
            while picture.taken - self._waiting[0] > 2 * WARM_UP:
                self._waiting.popleft()
            return
        self._first = picture.taken if self._first is None else self._first
        late = (picture.taken - self._first) * self.rate - self.frames
        if late < -SLACK:
            self.left_out += 1
            return
        missed = round(late) if late > SLACK else 0
        for image in (*[last.image] * missed, picture.image):
            self._add(image)
        self.frames += missed + 1
        self.repeated += missed
