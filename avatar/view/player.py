"""Which frame is shown now: of a motion that plays, stands still or is scrubbed, or of a stream."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from avatar.runs.motion_clip import Clip
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera, HeadParams
from avatar.view.live import LiveFrame

NEUTRAL, STREAM, WEBCAM = "neutral face", "stream", "webcam"


@dataclass(frozen=True)
class Shown:
    params: HeadParams
    camera: Camera
    recorded: int | None  # of the avatar's own video
    key: object  # another one for another frame
    taken: float | None = None  # seconds of `time.monotonic`, of a live frame


class Player:
    """`clock` gives seconds; `live` the newest frame of what is called `live_name`, or None before the first."""

    def __init__(
        self,
        trained: TrainedAvatar,
        clips: Mapping[str, Clip],
        clock: Callable[[], float],
        live: Callable[[], LiveFrame | None] | None = None,
        live_name: str = STREAM,
    ) -> None:
        self._clips, self._clock, self._live = dict(clips), clock, live
        self._rest = Shown(trained.rest_params(), trained.rest_camera(), None, NEUTRAL)
        self.live_name = live_name
        self.name = NEUTRAL if live is None else live_name
        self.is_playing = False
        self._since, self._first = 0.0, 0

    @property
    def names(self) -> tuple[str, ...]:
        return (NEUTRAL, *self._clips, *([self.live_name] if self._live else []))

    @property
    def clip(self) -> Clip | None:
        return self._clips.get(self.name)

    @property
    def index(self) -> int:
        """Of the frame in the clip that is shown; it starts again after its end."""
        clip = self.clip
        if clip is None:
            return 0
        passed = int((self._clock() - self._since) * clip.fps) if self.is_playing else 0
        return (self._first + passed) % len(clip)

    @property
    def seconds(self) -> float:
        """Of the frame that is shown, from the clip's first."""
        return self.index / self.clip.fps if self.clip else 0.0

    @property
    def duration(self) -> float:
        """Seconds from the clip's first frame to its last."""
        return (len(self.clip) - 1) / self.clip.fps if self.clip else 0.0

    def choose(self, name: str) -> None:
        if name not in self.names:
            raise ValueError(f"there is no motion {name!r}; there are {', '.join(self.names)}")
        self.name, self._first, self.is_playing = name, 0, False

    def play(self) -> None:
        self._first, self._since = self.index, self._clock()
        self.is_playing = self.clip is not None

    def pause(self) -> None:
        self._first, self.is_playing = self.index, False

    def seek(self, seconds: float) -> None:
        """To the nearest frame of the clip; what plays goes on from there."""
        if (clip := self.clip) is not None:
            self._first = round(min(max(seconds, 0.0), self.duration) * clip.fps)
            self._since = self._clock()

    def now(self) -> Shown:
        clip = self.clip
        if clip is not None:
            index = self.index
            params, camera = clip.frames[index]
            return Shown(params, camera, clip.recorded[index] if clip.recorded else None, (self.name, index))
        if self.name == self.live_name and self._live is not None and (newest := self._live()) is not None:
            camera = newest.camera or self._rest.camera
            return Shown(newest.params, camera, None, (self.name, newest.number), newest.taken)
        return self._rest
