"""`avatar track`: from a video to a tracked folder, in stages that an interruption does not undo.

look     by how much the pictures are turned, every picture's faces; one person, one shot, a regular grid of times
frames   the crop of every picture with the face
matte    the person against the background
despilled  the frames again, where the background's colours have run into the person
fit      identity, and pose and expression of every frame: by landmarks, then by pictures where that gains
head     head and neck without clothes
mouth    the lips and what is between them
torso    how the torso is turned against the head, by the clothes
overlay  the tracked mesh over the frames, for the eye
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from avatar.errors import UserError
from avatar.files.third_party import MATTING_FILES
from avatar.head.assets import HeadAssets
from data_prep.formats.avatar_track import (
    FRAMES,
    LANDMARKS_FILE,
    TrackingInfo,
    read_info,
    recognise,
    write_tracking,
)
from data_prep.formats.frame_files import describe_numbers
from data_prep.progress import Progress, silent
from data_prep.track.cache_key import look_inputs, tracking_key
from data_prep.track.faces.detect import FaceDetector
from data_prep.track.faces.landmarks import load_landmarks, save_landmarks
from data_prep.track.first_pass import FirstPass, from_json, look_at, to_json
from data_prep.track.fit.focal import Focal
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.rotated import turned
from data_prep.track.footage.source import Footage, View, check_span
from data_prep.track.frames import in_view
from data_prep.track.mattes.matting_network import check_matting
from data_prep.track.mattes.segmentation_network import matte_network
from data_prep.track.mattes.user_mattes import OwnMattes, open_mattes, refuse_mattes_of_others
from data_prep.track.quality import grade_tracking
from data_prep.track.stage_folder import StageFolder, growing
from data_prep.track.tracking_stages import DESPILLED, Choices, TrackingStages
from data_prep.track.upright import find_upright, sample_pictures

SPILL = (
    "the background's colours reach {} pixels into the person's outline, as compression blurs them; they are taken out"
)
TURNED = "the pictures are turned by {} degrees clockwise, {}"
COVERED = "the face looks unlike itself, as with a hand before it, at {} s"
WITHOUT = "the mattes leave out most of the face in frames {}"
LYING, GIVEN = "since the head lies in them (--rotate 0 leaves them)", "as --rotate says"
NO_FACE, NO_PICTURE = "the person's face was not found", "the video has no picture at this time"


def track(
    video: Path | Footage,
    out: Path,
    head_path: Path,
    head: HeadAssets,
    choices: Choices | None = None,
    say: Callable[[str], object] = print,
    progress: Progress = silent,
    seal: Callable[[Path], object] = lambda _: None,
) -> TrackingInfo:
    """Track one person's face through `video` (a file or a folder of pictures) and write the tracked folder `out`.

    The folder appears under its name when it is complete; until then its stages lie beside it, and the same call goes on
    from them. Nothing is done where `out` holds just this already. Raises UserError, with what to do, where the video or
    the choices are of no use, and where `out` is something else. `seal` is called with the complete folder before it gets
    its name.
    """
    choices = choices or Choices()
    footage = video if isinstance(video, Footage) else open_footage(video)
    say(f"{footage.path}: {footage.width}x{footage.height} pixels" + _rate_and_length(footage))
    for note in (*footage.notes, *head.notes):
        say(f"note: {note}")
    check_span(choices.span, footage.duration)
    network, options, seen = matte_network(), choices.to_json(), look_inputs(footage)
    key = tracking_key(footage, options, head_path, head)
    if out.exists() and not _is_empty(out):
        if recognise(out) and (known := read_info(out)).source.get("key") == key:
            say(f"{out} holds this tracking already")
            return known
        raise UserError(f"{out} exists and is not this tracking: choose another --out, or remove it first")
    mattes = None if choices.matte is None else open_mattes(choices.matte, footage, choices.span)
    for note in mattes.notes if mattes else ():
        say(f"note: {note}")
    if mattes is None and network in MATTING_FILES:
        check_matting(network)
        say(f"mattes by {network.name}")
    with growing(out) as stages, _interruptible(out, say):
        seen |= {"matte": options["matte"], "rotate": choices.rotate}
        turn, look = _look(stages, choices, footage, mattes, seen, progress)
        footage, mattes = turned(footage, turn), mattes and mattes.turned(turn)
        work = TrackingStages(stages, footage, choices, head, progress)
        for note in look.notes:
            say(f"note: {note}")
        view, focal = work.view_and_focal(look)
        say(f"focal length {focal.pixels:.0f} pixels of the video, {focal.source}" + _crop_words(view, footage))
        landmarks = in_view(look.landmarks, view)
        frames_key = work.frames(look, view, [seen, options])
        without, matte_key = work.mattes(look, view, mattes, network, frames_key, options)
        spill = work.despill(landmarks, [frames_key, matte_key])
        outline_notes = (
            *([WITHOUT.format(describe_numbers(without))] if without else []),
            *([SPILL.format(spill)] if spill else []),
        )
        for note in outline_notes:
            say(f"note: {note}")
        notes = (*footage.notes, *(mattes.notes if mattes else ()), *look.notes, *outline_notes)
        fit = work.fit(landmarks, _camera(focal, view, footage, choices), head_path, [frames_key, matte_key])
        if covered := fit.figures.get("covered"):
            rate, begins = look.landmarks.fps, look.begins
            notes = (*notes, COVERED.format(describe_numbers(covered, name=lambda n: f"{begins + n / rate:.1f}")))
            say(f"note: {notes[-1]}")
        overlaps, outline = work.masks(landmarks, fit)
        fit = work.torso(fit)
        work.overlay(fit, look)
        quality = grade_tracking(landmarks, int((look.pictures >= 0).sum()), fit, overlaps, outline, focal)
        for line in quality.lines():
            say(line)
        save_landmarks(stages.path / LANDMARKS_FILE, landmarks)
        info = TrackingInfo(
            fps=look.landmarks.fps,
            width=view.width,
            height=view.height,
            intrinsics=_camera(focal, view, footage, choices),
            focal=focal.source,
            focal_is_assumed=focal.is_assumed,
            head_path=str(head_path.resolve()),
            head_fingerprint=head.fingerprint,
            source={
                "video": footage.path.name,
                "sha256": footage.content_hash,
                "key": key,
                "turned": turn,
                "box": list(view.box),
                "begins": look.begins,
            }
            | options,
            left_out=_left_out(look),
            notes=notes,
            quality=quality.to_json(),
        )
        write_tracking(stages.path, info, fit.tracks)
        if spill:
            stages.finish(out, ("look", "fit", "torso"), {DESPILLED: FRAMES}, seal)
        else:
            stages.finish(out, ("look", "fit", "torso", DESPILLED), seal=seal)
    say(f"tracked {len(fit.tracks)} frames in {out}")
    return info


def _look(
    stages: StageFolder,
    choices: Choices,
    footage: Footage,
    mattes: OwnMattes | None,
    inputs: dict[str, Any],
    progress: Progress,
) -> tuple[int, FirstPass]:
    """By how many degrees the pictures are turned clockwise, and the first look at them then.

    Raises UserError for mattes that do not show the person.
    """

    def make(folder: Path) -> dict[str, Any]:
        turn = choices.rotate
        if turn is None or mattes is not None:
            pictures = [picture.image for picture in sample_pictures(footage, choices.span)]
            with FaceDetector() as detector:
                turn, faces = find_upright(pictures, detector.anywhere, choices.rotate)
            if mattes is not None:
                refuse_mattes_of_others(mattes.turned(turn), choices.span, faces)
        look = look_at(turned(footage, turn), choices.span, progress)
        if turn:
            look.notes.insert(0, TURNED.format(turn, LYING if choices.rotate is None else GIVEN))
        save_landmarks(folder / LANDMARKS_FILE, look.landmarks)
        return to_json(look) | {"turn": turn}

    raw, _ = stages.run("look", inputs | {"span": list(choices.span)}, make)
    return raw["turn"], from_json(raw, load_landmarks(stages.path / "look" / LANDMARKS_FILE))


def _camera(focal: Focal, view: View, footage: Footage, choices: Choices) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of the view; the principal point is the middle of the source picture, or calibrated."""
    fx, fy, *centre = choices.camera or (focal.pixels, focal.pixels, footage.width / 2, footage.height / 2)
    return fx * view.width / view.box.width, fy * view.height / view.box.height, *view.to_view(*centre)


def _left_out(look: FirstPass) -> dict[int, str]:
    lost = np.flatnonzero(~look.landmarks.detected).tolist()
    return {n: NO_FACE if look.pictures[n] >= 0 else NO_PICTURE for n in lost}


@contextmanager
def _interruptible(out: Path, say: Callable[[str], object]) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        say(f"interrupted: the same command goes on after the last stage that was complete (beside {out})")
        raise


def _rate_and_length(footage: Footage) -> str:
    rate = "" if footage.rate is None else f", {footage.rate:g} a second"
    return rate + ("" if footage.duration is None else f", {footage.duration:.1f} s")


def _crop_words(view: View, footage: Footage) -> str:
    box = view.box
    if (box.width, box.height) == (footage.width, footage.height):
        return f"; frames of {view.width}x{view.height} pixels show the whole picture"
    return f"; frames of {view.width}x{view.height} pixels show {box.width}x{box.height} from {box.x},{box.y} on"


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and next(folder.iterdir(), None) is None
