"""Whether the masks show the person and not the background.

The tracked mesh says where the head is, whichever frame it is taken from: a head hardly moves by its own size. Inverted
masks have nothing there and everything in the upper corners of the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import NamedTuple

import cv2
import numpy as np

from avatar.head.model import HeadModel
from data_prep.formats.frame_files import ALPHA, HEAD, MOUTH, FrameFiles, describe_numbers
from data_prep.formats.frame_track import FrameTrack
from data_prep.formats.tracked_folder import Shot, spread_by_camera
from data_prep.prepare.check_alignment import SAMPLED_FRAMES
from data_prep.prepare.mask_overlap import MeshProjector, measured_size
from data_prep.prepare.mask_values import WHAT, place_of
from data_prep.prepare.projection import silhouette

MAX_ON_HEAD, MIN_IN_CORNERS, MIN_COVERED = 0.25, 0.75, 0.35  # of an inverted mask, mean opacity; the last of all of it
MIN_OPAQUE = 0.5  # of a matte, on the head mask; of a head mask, on the mesh
MAX_MOUTH = 0.5  # of the picture
_CORNER = 8  # of the picture's sides is a corner's


class _Frame(NamedTuple):
    number: int  # of the image
    masks: dict[str, np.ndarray]  # kind -> float32 [h, w], 0 to 1
    head: np.ndarray  # bool [h, w], where the mesh is


_Judge = Callable[[_Frame, np.ndarray], str | None]
"""What is wrong with one of the frame's masks, with a figure; None where nothing is."""


def polarity_problems(
    head: HeadModel,
    tracks: Mapping[int, FrameTrack],
    files: FrameFiles,
    max_left_out: float,
    without: Collection[int] = (),
    shots: Mapping[int, Shot] | None = None,
) -> list[str]:
    """Sentences on masks that are inverted, and on mattes that are transparent on the head, where more than a share of some
    frames are so. Frames `without` cannot be read."""
    frames = list(_frames(head, tracks, files, without, shots))
    judges: tuple[tuple[str, _Judge], ...] = (
        (HEAD, _inverted),
        (ALPHA, _inverted),
        (MOUTH, _everywhere),
        (ALPHA, _transparent),
    )
    problems = {}
    for kind, judge in judges:
        seen = [frame for frame in frames if kind in frame.masks]
        found = {frame.number: words for frame in seen if (words := judge(frame, frame.masks[kind])) is not None}
        if len(found) > max_left_out * len(seen) and not {kind, HEAD} & problems.keys():
            names, first = files.frame_names(), next(iter(found))
            shown = describe_numbers(list(found), 6, names.__getitem__)
            problems[kind] = (
                f"the {WHAT[kind]} in {place_of(files.of_kind()[kind])} {found[first]} in {names[first]}, and so in "
                f"{len(found)} of {len(seen)} sampled frames ({shown}); make what is of the person white (255) and all "
                "else black (0)"
            )
    return list(problems.values())


def _inverted(frame: _Frame, mask: np.ndarray) -> str | None:
    if not frame.head.any():
        return None
    on_head = float(mask[frame.head].mean())
    rows, columns = (max(1, side // _CORNER) for side in mask.shape)
    in_corners = min(float(mask[:rows, part].mean()) for part in (slice(columns), slice(-columns, None)))
    if on_head > MAX_ON_HEAD or in_corners < MIN_IN_CORNERS or mask.mean() < MIN_COVERED:
        return None
    return f"are inverted: {on_head:.0%} of the tracked head and {in_corners:.0%} of the upper corners are on them"


def _everywhere(frame: _Frame, mask: np.ndarray) -> str | None:
    share = float(mask.mean())
    return f"are inverted: {share:.0%} of the picture is on them" if share > MAX_MOUTH else None


def _transparent(frame: _Frame, matte: np.ndarray) -> str | None:
    head = frame.masks.get(HEAD)
    if head is None or not frame.head.any() or head[frame.head].mean() < MIN_OPAQUE:
        return None  # how the mesh lies on the masks is judged elsewhere
    opaque = float(matte[head > 0.5].mean())
    return f"are transparent where the head is: {opaque:.0%} opaque on the head mask" if opaque < MIN_OPAQUE else None


def _frames(
    head: HeadModel,
    tracks: Mapping[int, FrameTrack],
    files: FrameFiles,
    without: Collection[int],
    shots: Mapping[int, Shot] | None,
) -> Iterator[_Frame]:
    usable = [number for number in files.images if number not in without]
    if not usable or not tracks:
        return
    tracked = list(tracks.values())
    project = MeshProjector(head)
    places = np.linspace(0, len(tracked) - 1, len(usable)).round().astype(int).tolist()
    place_of_track = dict(zip(usable, places, strict=True))
    for number in spread_by_camera(usable, SAMPLED_FRAMES, shots):
        masks, size = {}, None
        for kind in (ALPHA, HEAD, MOUTH):
            if (pixels := files.read(kind, number)) is not None:
                size = measured_size(pixels.shape[1], pixels.shape[0])
                masks[kind] = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        if size is not None:
            own = tracks.get(number) if files.pairing else None  # the folder pairs them; else a head hardly moves
            mesh = project(own or tracked[place_of_track[number]], *size)
            yield _Frame(number, masks, silhouette(mesh.screen, mesh.skin_faces, *size) > 0)
