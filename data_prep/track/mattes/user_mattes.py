"""The mattes that a person gives for a video: a folder or a video of all its pictures, checked before anything is made.

Folders of label images with one value besides 0 are understood, as in tracked folders (`mask_values`). What does not show
the person is refused with the figure that says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from avatar.data.read_image import decode_image, decode_mask, decode_values, read_bytes
from avatar.data.split import evenly_spread
from avatar.errors import UserError
from data_prep.prepare.mask_values import SAMPLES, coloured_sentence, is_coloured, judge_range, only_label
from data_prep.track.faces.detect import Face
from data_prep.track.footage.picture_folder import PictureFolder, open_footage, resampled
from data_prep.track.footage.rotated import turned
from data_prep.track.footage.source import MIN_SIDE, Footage, Span, TimedPicture, View, whole
from data_prep.track.footage.timing import DEFAULT_FPS
from data_prep.track.footage.video import Video
from data_prep.track.upright import LONGEST, sample_pictures

OPAQUE = 0.5  # of the face: less is not the person's matte
_SAMPLES = 16  # pictures of a video of mattes
_SAME_RATE = 5e-4  # relative: rates are said to a hundredth


@dataclass(frozen=True)
class OwnMattes:
    footage: Footage
    notes: tuple[str, ...] = ()
    later: float = (
        0.0  # seconds: when the video's first picture is in its file, less when the first matte is in its own
    )

    def turned(self, degrees: int) -> OwnMattes:
        return replace(self, footage=turned(self.footage, degrees))

    def read(self, view: View, span: Span) -> Iterator[TimedPicture]:
        """The mattes, uint8 [H, W], in the order of the times of the video's pictures."""
        own = Span(max(0.0, span.start - self.later), None if span.end is None else span.end - self.later)
        for time, image in self.footage.read(view, own, lambda _: None):
            yield TimedPicture(time + self.later, _grey(image))


def open_mattes(path: Path, video: Footage, span: Span | None = None) -> OwnMattes:
    """Raises UserError for what cannot be the mattes of the video's pictures, of which those in `span` are used."""
    footage = open_footage(path)
    if (footage.width, footage.height) != (video.width, video.height):
        raise UserError(
            f"the mattes in {path} are {footage.width}x{footage.height} pixels, the video {video.width}x{video.height}; "
            "make them of the video's own pictures"
        )
    found = [set(np.unique(each).tolist()) for each in _values_of_some(footage)]
    if not found:
        raise UserError(f"none of the pictures in {path} can be decoded; make the mattes again")
    label = only_label(found) if isinstance(footage, PictureFolder) else None  # a video's are not exact
    notes = [] if label is None else [f"the mattes in {path} are label images: {label} is read as 255"]
    if label is None:
        darkest, brightest = min(map(min, found)), max(map(max, found))
        problem, note = judge_range(f"the mattes in {path}", darkest, brightest, lambda: found)
        if darkest == brightest > 0:
            problem = f"the mattes in {path} are {darkest} of 255 everywhere: they cut nobody out; leave --matte out"
        if problem is not None:
            raise UserError(problem)
        notes += [note] if note else []
    if isinstance(footage, PictureFolder):
        rate = video.rate or DEFAULT_FPS
        times = () if span in (None, Span()) else _times_of(video, len(footage.files), span.end)
        duration = len(footage.files) / rate
        as_masks = replace(footage, decode=_mask_reader(label), rate=rate, duration=duration, times=times)
        return OwnMattes(as_masks, tuple(notes))
    is_part, own_rate, rate = span not in (None, Span()), footage.rate, video.rate
    if is_part and own_rate and rate and abs(own_rate / rate - 1) > _SAME_RATE:
        raise UserError(
            f"the mattes in {path} have {own_rate:g} pictures a second, the video {rate:g}, so that --start and --end are "
            "at other pictures in each; make them at the video's rate, or give a folder of them"
        )
    begins, own = (one.first.time or 0.0 if isinstance(one, Video) else 0.0 for one in (video, footage))
    if abs(begins - own) > 0.5 / (video.rate or DEFAULT_FPS):
        notes.append(
            f"the mattes in {path} begin at {own:.2f} s of their file and the video's pictures at {begins:.2f} s: the "
            "first matte is taken for the first picture's"
        )
    return OwnMattes(footage, tuple(notes), begins - own)


def _times_of(video: Footage, count: int, end: float | None) -> tuple[float, ...]:
    """When the video shows its first `count` pictures, which its rate alone does not say: it may begin late, or vary.

    From `end` on as the rate says. Empty where that says it all, and where the video cannot be read from its beginning on.
    """
    if isinstance(video, PictureFolder):
        return ()
    times: list[float] = []
    small = whole(video.width, video.height, MIN_SIDE)
    try:
        for picture in video.read(small, Span(), lambda _: None, every=1):
            times.append(picture.time)
            if len(times) == count or (end is not None and picture.time >= end):
                break
    except UserError:
        return ()
    missing = np.arange(1, count - len(times) + 1) / (video.rate or DEFAULT_FPS)
    return (*times, *(times[-1] + missing).tolist())


def refuse_mattes_of_others(mattes: OwnMattes, span: Span, faces: Sequence[Face | None]) -> None:
    """Raises UserError where the mattes do not show the faces of the video's sampled pictures (see `sample_pictures`).

    A head hardly moves by its own size, so that the times need not agree exactly.
    """
    footage = mattes.footage
    size, small = whole(footage.width, footage.height), whole(footage.width, footage.height, LONGEST)
    shares = []
    for face, (_, image) in zip(faces, sample_pictures(footage, span, size), strict=False):
        if face is not None:
            shares.append(share_on(face.points[:, :2], resampled(_grey(image), small)))
    if not shares:
        return
    on_face, beside = np.median(np.array(shares), axis=0)
    if on_face < OPAQUE:
        what = "inverted" if beside > OPAQUE else "not of this person"
        raise UserError(
            f"the mattes in {footage.path} are {what}: {on_face:.0%} of the face and {beside:.0%} of the rest of the "
            f"picture are on them, in the median of {len(shares)} pictures; make the person white (255) and all else "
            "black (0), in the video's own pictures as they were filmed"
        )


def share_on(points: Float[np.ndarray, "L 2"], matte: UInt8[np.ndarray, "H W"]) -> tuple[float, float]:
    """How opaque, 0 to 1, a matte is on the face with these landmarks, and beside it."""
    outline = cv2.convexHull(np.clip(points, -(2**13), 2**13).astype(np.int32))
    inside = cv2.fillConvexPoly(np.zeros(matte.shape, np.uint8), outline, 1) > 0
    if inside.all() or not inside.any():
        return float(matte.mean() / 255), float(matte.mean() / 255)
    return float(matte[inside].mean() / 255), float(matte[~inside].mean() / 255)


def _mask_reader(label: int | None) -> Callable[[Path], tuple[np.ndarray, bool]]:
    def read(file: Path) -> tuple[np.ndarray, bool]:
        return cv2.cvtColor(decode_mask(read_bytes(file), file, label), cv2.COLOR_GRAY2RGB), False

    return read


def _values_of_some(footage: Footage) -> Iterator[UInt8[np.ndarray, "H W"]]:
    """Raises UserError where they are pictures in colour."""
    if isinstance(footage, PictureFolder):
        for file in evenly_spread(footage.files, SAMPLES):
            data = read_bytes(file)
            values = decode_values(data, file)
            if is_coloured(decode_image(data, file), values):
                raise UserError(coloured_sentence(str(file), "mattes"))
            yield values
        return
    for picture in sample_pictures(footage, Span(), whole(footage.width, footage.height), _SAMPLES):
        values = _grey(picture.image)
        if is_coloured(picture.image, values):
            raise UserError(coloured_sentence(f"{footage.path} at {picture.time:.2f} s", "mattes"))
        yield values


def _grey(image: np.ndarray) -> UInt8[np.ndarray, "H W"]:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
