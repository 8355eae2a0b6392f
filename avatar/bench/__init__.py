"""Measurements of the program's own speed and accuracy: `avatar bench PART`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple


class Part(NamedTuple):
    """`module` has run(request: Request) -> None, which prints a table and writes files into `request.out`."""

    module: str
    inputs: str = ""  # what stands after the part's name: nothing, SUBJECT, [SUBJECT], RUN or RUN...
    on_gpu: bool = False  # whether it measures a GPU too


@dataclass(frozen=True)
class Request:
    """What is asked of a benchmark."""

    out: Path  # a folder that exists
    quick: bool = False  # tiny inputs, seconds: does the measurement itself work?
    full: bool = False  # the long sweep, where there is one
    inputs: tuple[Path, ...] = ()  # as many as the part names
    overrides: tuple[str, ...] = ()  # key=value of the configuration, for parts that train
    head: Path | None = None
    tracking: Path | None = None
    frame_offset: int | None = None
    device: str = "cpu"  # or a GPU that has passed its test, as torch calls it; for parts that measure one


PARTS = {
    "splat": Part("avatar.bench.splat_report", on_gpu=True),
    "hyper": Part("avatar.bench.hyper_report"),
    "render": Part("avatar.bench.render", "RUN", on_gpu=True),
    "transfer": Part("avatar.bench.transfer"),
    "train": Part("avatar.bench.train", "SUBJECT", on_gpu=True),
    "quality": Part("avatar.bench.quality", "RUN..."),
    "stability": Part("avatar.bench.stability"),
    "refine": Part("avatar.bench.refine", "SUBJECT"),
    "track": Part("avatar.bench.track", "[SUBJECT]"),
}
