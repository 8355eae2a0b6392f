"""Several takes of one camera as one footage, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from avatar.errors import UserError
from data_prep.track.footage.source import Footage, Span, TimedPicture, View, common_fields
from data_prep.track.stage_folder import hash_of


@dataclass(frozen=True)
class JoinedFootage(Footage):
    """Part n begins at `starts[n]` seconds, behind the end of the one before it."""

    is_joined: ClassVar[bool] = True

    parts: tuple[Footage, ...]
    starts: tuple[float, ...]

    def read(
        self, view: View, span: Span, complain: Callable[[str], object], every: int | None = None
    ) -> Iterator[TimedPicture]:
        for part, start in zip(self.parts, self.starts, strict=True):
            begin, end = max(0.0, span.start - start), None if span.end is None else span.end - start
            if (end is not None and end <= 0) or begin >= (part.duration or 0.0):
                continue
            for picture in part.read(view, Span(begin, end), complain, every):
                yield picture._replace(time=start + picture.time)

    @cached_property
    def content_hash(self) -> str:
        return hash_of([[part.content_hash for part in self.parts], self.starts])


def join(parts: Sequence[Footage], starts: Sequence[float]) -> JoinedFootage:
    """Takes of one camera. Raises UserError where they differ in size or rate, or do not say how long they are."""
    first = parts[0]
    for part in parts:
        if part.duration is None:
            raise UserError(
                f"{part.path} does not say how long it is, so nothing can follow it; convert it to .mp4 (H.264) first"
            )
        if (part.width, part.height, part.rate) != (first.width, first.height, first.rate):
            raise UserError(
                f"{part.path} has {part.width}x{part.height} pixels at {part.rate} a second, but {first.path} has "
                f"{first.width}x{first.height} at {first.rate}; track recordings of different cameras by themselves"
            )
    values = common_fields(first)
    values |= {
        "path": first.path.parents[1].resolve().with_name("*") / Path(*first.path.parts[-2:]),
        "duration": starts[-1] + (parts[-1].duration or 0.0),
    }
    values |= {"notes": tuple(dict.fromkeys(note for part in parts for note in part.notes))}
    return JoinedFootage(**values, parts=tuple(parts), starts=tuple(starts))
