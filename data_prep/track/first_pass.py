"""The first look at a clip: every picture's faces, one person's landmarks, the cuts and the times."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from avatar.errors import UserError
from data_prep.progress import Progress
from data_prep.track.faces.detect import Face, FaceDetector
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks
from data_prep.track.faces.person import follow_one
from data_prep.track.footage.cuts import CutFinder, Shot
from data_prep.track.footage.source import Footage, Span, stride, whole
from data_prep.track.footage.timing import Timing, regular_timing

DETECTION_SIDE = 1920  # pixels of the longer side; the landmarks come from 256 pixels around the face
MAX_PICTURES = 3600  # two minutes at 30 a second
MIN_PICTURES = 10
_PAUSE = 1.0  # seconds without a picture that count as a cut, if they are also several times the usual distance
_PAUSES = 5.0
_SLOW = 8.0  # pictures a second
_DARK = 12.0  # grey levels: below, a picture is called black


@dataclass(frozen=True)
class FirstPass:
    """What is known after the first look; frame numbers are places on a regular grid in time."""

    landmarks: Landmarks  # T frames, in pixels of the upright source pictures
    pictures: np.ndarray  # int64 [T], which of the pictures that were read; -1 where the grid has none
    read: int  # how many pictures were read
    is_whole: bool  # whether these were all between --start and --end
    notes: list[str]
    begins: float = 0.0  # seconds into the video, of frame 0
    between: tuple[float, float] = (0.0, 0.0)  # likewise, of the first picture that was read and of the last


def look_at(footage: Footage, span: Span, progress: Progress) -> FirstPass:
    """Find one person's face in the shot that shows one longest. Raises UserError, with what to do, where there is none."""
    notes: list[str] = []
    view = whole(footage.width, footage.height, DETECTION_SIDE)
    scale = np.array([footage.width / view.width, footage.height / view.height, footage.width / view.width], np.float32)
    times: list[float] = []
    found: list[list[Face]] = []
    brightest, is_whole = 0.0, True
    cuts = CutFinder()
    expected = None
    if footage.duration is not None and footage.rate:
        seconds = min(footage.duration, span.end or footage.duration) - span.start
        expected = max(1, round(seconds * footage.rate / stride(footage.rate)))
        if footage.is_joined and expected > MAX_PICTURES:
            raise UserError(f"the recordings have {expected} times together; give at most {MAX_PICTURES}")
        expected = min(MAX_PICTURES, expected)
    with FaceDetector() as detector:
        for picture in progress(footage.read(view, span, notes.append), expected, "looking for the face"):
            if len(times) == MAX_PICTURES:
                notes.append(_too_long(times[0], picture.time))
                is_whole = False
                break
            times.append(picture.time)
            brightest = max(brightest, float(picture.image[::4, ::4].mean()))
            faces = detector.find(picture.image, cuts.add(picture.image))
            found.append([Face(face.points * scale, face.scores) for face in faces])
    if len(times) < MIN_PICTURES:
        where = "" if span == Span() else " between --start and --end"
        raise UserError(
            f"{footage.path} has {len(times)} picture{'' if len(times) == 1 else 's'}{where}{_because(notes)}; "
            f"{MIN_PICTURES} at least are needed, and some hundred to learn a face from"
        )
    if not any(found):
        why = "they are black" if brightest < _DARK else "it must be seen from the front, lit, and be no speck"
        raise UserError(
            f"no face was found in any of the {len(times)} pictures of {footage.path}{_because(notes)}: {why}"
        )
    shots = [Shot(0, len(times))] if footage.is_joined else cuts.shots()
    shot = _shot_of_a_face(shots, np.array(times), found, notes)
    faces, about = follow_one(found[shot.start : shot.end])
    notes += about
    return _on_grid(footage, shot, np.array(times), faces, is_whole, notes)


def _shot_of_a_face(cut: list[Shot], times: np.ndarray, found: list[list[Face]], notes: list[str]) -> Shot:
    """The shot with the most pictures of a face."""
    shots = [part for shot in cut for part in _without_pauses(shot, times)]
    best = max(shots, key=lambda shot: sum(map(bool, found[shot.start : shot.end])))
    if len(shots) > 1:
        seconds = times[best.end - 1] - times[best.start]
        notes.append(
            f"the video is cut into {len(shots)} shots: the one with the most pictures of a face is used, "
            f"{seconds:.1f} s from {times[best.start]:.1f} s on ({best.length} of {len(times)} pictures); --start and "
            "--end choose others"
        )
    return best


def _without_pauses(shot: Shot, times: np.ndarray) -> list[Shot]:
    steps = np.diff(times[shot.start : shot.end])
    usual = float(np.median(steps)) if len(steps) else 0.0
    breaks = shot.start + 1 + np.flatnonzero(steps > max(_PAUSE, _PAUSES * usual))
    edges = [shot.start, *breaks.tolist(), shot.end]
    return [Shot(*both) for both in itertools.pairwise(edges)]


def _on_grid(
    footage: Footage, shot: Shot, times: np.ndarray, faces: list[Face | None], is_whole: bool, notes: list[str]
) -> FirstPass:
    own = times[shot.start : shot.end]
    stated = None if footage.rate is None else footage.rate / stride(footage.rate)
    if footage.is_joined and stated is not None:
        timing = Timing(stated, np.rint((own - own[0]) * stated).astype(np.int64), ())
    else:
        timing = regular_timing(own, stated)
    notes += timing.notes
    if timing.fps < _SLOW:
        notes.append(
            f"at {timing.fps:.3g} pictures a second neighbours are too unlike for the tracking to be smoothed over time"
        )
    T = int(timing.numbers.max()) + 1
    points, scores = np.zeros((T, NUM_POINTS, 3), np.float32), np.zeros((T, len(BLENDSHAPES)), np.float32)
    pictures, detected = np.full(T, -1, np.int64), np.zeros(T, bool)
    for n, (number, face) in enumerate(zip(timing.numbers.tolist(), faces, strict=True)):
        if number < 0:
            continue
        pictures[number] = shot.start + n
        if face is not None:
            points[number], scores[number], detected[number] = face.points, face.scores, True
    seen = int(detected.sum())
    if seen < MIN_PICTURES:
        raise UserError(
            f"one face was found in only {seen} of {len(own)} pictures of {footage.path}{_because(notes)}; "
            f"{MIN_PICTURES} at least are needed: it must be seen from the front, lit, and be no speck"
        )
    size = footage.width, footage.height
    landmarks = Landmarks(points, scores, detected, size, timing.fps)
    between = float(times[0]), float(times[-1])
    return FirstPass(landmarks, pictures, len(times), is_whole, notes, float(own[0]), between)


def _too_long(first: float, last: float) -> str:
    return (
        f"the clip is longer than {MAX_PICTURES} pictures: those from {first:.1f} to {last:.1f} s are used; --start and "
        "--end choose others"
    )


def _because(notes: list[str]) -> str:
    return f" ({'; '.join(notes)})" if notes else ""


def to_json(look: FirstPass) -> dict[str, Any]:
    """All but the landmarks."""
    return {
        "pictures": look.pictures.tolist(),
        "read": look.read,
        "is_whole": look.is_whole,
        "notes": look.notes,
        "begins": look.begins,
        "between": look.between,
    }


def from_json(raw: dict[str, Any], landmarks: Landmarks) -> FirstPass:
    pictures = np.array(raw["pictures"], np.int64)
    known = raw["read"], raw["is_whole"], list(raw["notes"]), raw["begins"], tuple(raw["between"])
    return FirstPass(landmarks, pictures, *known)
