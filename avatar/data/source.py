"""What a person says about a tracked folder: where it is, and what is known about it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DEFAULT_FPS = 25.0  # of FlashAvatar's protocol, where neither the folder nor a person says otherwise
MAX_FPS = 1000.0
DEFAULT_LEFT_OUT = 0.05  # of the frames: if more cannot be used, something is wrong with the whole, not with a frame


@dataclass(frozen=True)
class Source:
    """A tracked folder with its head model; None leaves a choice to the folder."""

    folder: Path
    head: Path
    tracking: Path | None = None  # folder of the .frame files, where it is another one
    frame_offset: int | None = None  # image number minus tracking number
    data_format: str | None = None  # one of data_prep.formats.detect.FORMATS
    fps: float | None = None  # of the video
    max_left_out: float = DEFAULT_LEFT_OUT  # share of the frames that may be unusable
    ignore_misfit: bool = False  # go on where the projected head does not lie on the masks
    cameras: str | None = None  # of a folder with several: "all", "front" or names between commas; None: all

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file: absolute paths as text."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {key: str(value.resolve()) if isinstance(value, Path) else value for key, value in values.items()}
