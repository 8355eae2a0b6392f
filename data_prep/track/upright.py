"""By how much a video must be turned so that its heads stand upright, from the landmarks of a few pictures.

A landmarker finds faces that lie on their side with their roll, but fits an upright face to one that is upside down. Each
picture is therefore tried at all four quarter turns, and every face found is a vote for the turn that makes it upright.
Three of the four tries are right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from avatar.errors import UserError
from data_prep.track.faces.detect import Face
from data_prep.track.footage.rotated import TURNS, turn_image
from data_prep.track.footage.source import Footage, Span, TimedPicture, View, whole

SAMPLES = 8  # pictures
LONGEST = 1280  # pixels of their longer side
_APART = 25  # pictures, where the length is not known
_TOP, _CHIN = 10, 152  # landmarks
_SURE = 2  # times the votes for no turn; a video of a head that tilts far is left as it is
_FEWEST = 4  # votes: two pictures' faces, or faces laid over something in half of them

FindFace = Callable[[UInt8[np.ndarray, "H W 3"]], Face | None]


class Upright(NamedTuple):
    turn: int  # degrees clockwise, of TURNS
    faces: list[Face | None]  # of the samples, in pixels of their turned pictures


def sample_pictures(
    footage: Footage, span: Span, view: View | None = None, count: int = SAMPLES
) -> Iterator[TimedPicture]:
    """Some pictures from all over the span, made smaller, or as `view` says; without those that cannot be read.

    A caller that reads all of them learns why, and where.
    """
    view = view or whole(footage.width, footage.height, LONGEST)
    if footage.duration is None:
        yield from islice(footage.read(view, span, lambda _: None), 0, _APART * count, _APART)
        return
    end = footage.duration if span.end is None else min(span.end, footage.duration)
    starts = span.start + (np.arange(count) + 0.5) / count * (end - span.start)
    for start in starts.tolist():
        picture = _first(footage.read(view, Span(start, span.end), lambda _: None))
        if picture is not None:
            yield picture


def _first(pictures: Iterator[TimedPicture]) -> TimedPicture | None:
    try:
        return next(pictures, None)
    except UserError:
        return None
    finally:
        pictures.close()  # type: ignore[attr-defined]  # ends the decoder


def find_upright(pictures: list[UInt8[np.ndarray, "H W 3"]], find: FindFace, given: int | None = None) -> Upright:
    """The turn that the pictures' faces ask for, or the `given` one; 0 where there are too few."""
    tries = TURNS if given is None else (given,)
    found = {turn: [find(turn_image(image, turn)) for image in pictures] for turn in tries}
    if given is not None:
        return Upright(given, found[given])
    votes: dict[int, int] = dict.fromkeys([*TURNS], 0)
    for turn, faces in found.items():
        for face in faces:
            if face is not None:
                votes[(turn - 90 * round(roll_of(face) / 90)) % 360] += 1
    best = max(votes, key=votes.__getitem__)
    turn = best if votes[best] >= max(_FEWEST, _SURE * votes[0]) else 0
    return Upright(turn, found[turn])


def roll_of(face: Face) -> float:
    """Degrees by which the face is turned clockwise in the picture, -180 to 180."""
    down = face.points[_CHIN, :2] - face.points[_TOP, :2]
    return float(np.degrees(np.arctan2(-down[0], down[1])))
