"""`avatar track`: from a video to a tracked folder, in stages that an interruption does not undo.

look     every picture's faces; one person, one shot, a regular grid of times
frames   the crop of every picture with the face
matte    the person against the background
fit      identity, and pose and expression of every frame
head     head and neck without clothes
mouth    the lips and what is between them
overlay  the tracked mesh over the frames, for the eye
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from avatar.errors import UserError
from avatar.files.third_party import FACE_LANDMARKER, SELFIE_MULTICLASS, SELFIE_SEGMENTATION, find
from avatar.head.assets import HeadAssets
from data_prep.avatar_track import (
    FRAMES,
    HEAD,
    LANDMARKS_FILE,
    MATTE,
    MOUTH,
    TRACKS_FILE,
    TrackingInfo,
    read_info,
    recognise,
    write_tracking,
)
from data_prep.track.crop import choose_view
from data_prep.track.fit_result import Clip, Fit
from data_prep.track.fitting import fit_tracks
from data_prep.track.focal import Focal, choose_focal
from data_prep.track.footage import Box, Footage, Span, View
from data_prep.track.frames import (
    FrameImages,
    FrameMattes,
    in_view,
    write_frames,
    write_given_mattes,
    write_masks,
)
from data_prep.track.landmarks import Landmarks, load_landmarks, save_landmarks
from data_prep.track.look import Look, from_json, look_at, to_json
from data_prep.track.masks import head_mask, mouth_mask, neck_ring
from data_prep.track.matte import open_matter
from data_prep.track.overlay import FrameParts, write_overlay
from data_prep.track.pictures import open_footage
from data_prep.track.quality import judge
from data_prep.track.stages import Stages, growing, hash_of

STAGES_VERSION = 1  # raised when what a stage makes changes
Item = TypeVar("Item")
Progress = Callable[[Iterable[Any], int | None, str], Iterable[Any]]


@dataclass(frozen=True)
class Choices:
    """What a person may say about a video."""

    crop: Literal["auto", "none"] | Box = "auto"
    size: int | None = None  # pixels of the longer side; None for 512 with crop="auto", else the video's
    span: Span = field(default_factory=Span)
    focal: float | None = None  # pixels of the video
    field_of_view: float | None = None  # degrees across the video's width
    matte: Path | None = None  # the user's own: a folder or a video of all pictures

    def to_json(self) -> dict[str, Any]:
        crop = self.crop if isinstance(self.crop, str) else list(self.crop)
        matte = None if self.matte is None else open_footage(self.matte).content_hash()
        return {"crop": crop, "size": self.size, "span": list(self.span), "focal": self.focal,
                "field_of_view": self.field_of_view, "matte": matte}  # fmt: skip


def silent(items: Iterable[Item], total: int | None, title: str) -> Iterable[Item]:
    return items


def track(
    video: Path,
    out: Path,
    head_path: Path,
    head: HeadAssets,
    choices: Choices | None = None,
    say: Callable[[str], object] = print,
    progress: Progress = silent,
) -> TrackingInfo:
    """Track one person's face through `video` (a file or a folder of pictures) and write the tracked folder `out`.

    The folder appears under its name when it is complete; until then its stages lie beside it, and the same call goes on
    from them. Nothing is done where `out` holds just this already. Raises UserError, with what to do, where the video or
    the choices are of no use, and where `out` is something else.
    """
    choices = choices or Choices()
    footage = open_footage(video)
    say(f"{video}: {footage.width}x{footage.height} pixels" + _rate_and_length(footage))
    for note in footage.notes:
        say(f"note: {note}")
    mattes = None if choices.matte is None else open_footage(choices.matte)
    network = _matte_network()
    options = choices.to_json()
    seen = {"video": footage.content_hash(), "version": STAGES_VERSION, "landmarks": FACE_LANDMARKER.sha256}
    key = hash_of([seen, options, head.fingerprint, network])
    if out.exists() and not _is_empty(out):
        if recognise(out) and (known := read_info(out)).source.get("key") == key:
            say(f"{out} holds this tracking already")
            return known
        raise UserError(f"{out} exists and is not this tracking: choose another --out, or remove it first")
    with growing(out) as stages:
        work = _Work(stages, footage, choices, head, progress)
        look = work.look(seen)
        for note in look.notes:
            say(f"note: {note}")
        view, focal = work.view_and_focal(look)
        say(f"focal length {focal.pixels:.0f} pixels of the video, {focal.source}" + _crop_words(view, footage))
        landmarks = in_view(look.landmarks, view)
        frames_key = work.frames(look, view, [seen, options])
        matte_key = work.mattes(look, view, mattes, network, frames_key, options)
        fit = work.fit(landmarks, _camera(focal, view, footage), head_path, [frames_key, matte_key])
        overlaps = work.masks(landmarks, fit)
        work.overlay(fit, look)
        quality = judge(landmarks, fit, overlaps, focal)
        for line in quality.lines():
            say(line)
        save_landmarks(stages.folder / LANDMARKS_FILE, landmarks)
        info = TrackingInfo(
            fps=look.landmarks.fps,
            width=view.width,
            height=view.height,
            intrinsics=_camera(focal, view, footage),
            focal=focal.source,
            focal_is_assumed=focal.is_assumed,
            head_path=str(head_path.resolve()),
            head_fingerprint=head.fingerprint,
            source={"video": video.name, "sha256": footage.content_hash(), "key": key, "crop": list(view.box)}
            | options,
            left_out=_left_out(look),
            notes=(*footage.notes, *look.notes),
            quality=quality.to_json(),
        )
        write_tracking(stages.folder, info, fit.tracks)
        stages.finish(out, ("look", "fit"))
    say(f"tracked {len(fit.tracks)} frames in {out}")
    return info


class _Work:
    """The stages of one video, each with what it was made from."""

    def __init__(
        self, stages: Stages, footage: Footage, choices: Choices, head: HeadAssets, progress: Progress
    ) -> None:
        self._stages, self._footage, self._choices, self._head = stages, footage, choices, head
        self._progress = progress
        self._folder = stages.folder
        self._faces = head.faces.numpy()

    def look(self, seen: dict[str, Any]) -> Look:
        span = self._choices.span

        def make(folder: Path) -> dict[str, Any]:
            look = look_at(self._footage, span, self._progress)
            save_landmarks(folder / LANDMARKS_FILE, look.landmarks)
            return to_json(look)

        raw, _ = self._stages.run("look", seen | {"span": list(span)}, make)
        return from_json(raw, load_landmarks(self._folder / "look" / LANDMARKS_FILE))

    def view_and_focal(self, look: Look) -> tuple[View, Focal]:
        points = look.landmarks.points[look.landmarks.detected]
        size = self._footage.width, self._footage.height
        view = choose_view(self._choices.crop, self._choices.size, *size, points)
        given = self._choices.focal, self._choices.field_of_view, self._footage.equivalent_focal
        return view, choose_focal(*size, points, *given)

    def frames(self, look: Look, view: View, inputs: list[Any]) -> str:
        def make(folder: Path) -> dict[str, Any]:
            write_frames(folder, self._footage, view, self._choices.span, look, self._progress)
            return {}

        return self._stages.run(FRAMES, {"of": inputs, "view": [*view.box, view.width, view.height]}, make)[1]

    def mattes(
        self, look: Look, view: View, given: Footage | None, network: str, frames_key: str, options: dict[str, Any]
    ) -> str:
        numbers = _numbers(look.landmarks)

        def make(folder: Path) -> dict[str, Any]:
            if given is not None:
                size = self._footage.width, self._footage.height
                write_given_mattes(folder, given, view, self._choices.span, look, size, self._progress)
                return {}
            matter, _ = open_matter()
            images = FrameImages(self._folder / FRAMES, numbers)
            rows = {number: row for row, number in enumerate(numbers)}
            write_masks(folder, numbers, lambda n: matter(images[rows[n]]), self._progress, "making mattes", workers=1)
            return {}

        return self._stages.run(MATTE, {"frames": frames_key, "network": network, "given": options["matte"]}, make)[1]

    def fit(
        self, landmarks: Landmarks, intrinsics: tuple[float, float, float, float], head_path: Path, inputs: list[Any]
    ) -> Fit:
        numbers = _numbers(landmarks)

        def make(folder: Path) -> dict[str, Any]:
            clip = Clip(
                landmarks,
                intrinsics,
                FrameImages(self._folder / FRAMES, numbers),
                FrameMattes(self._folder / MATTE, numbers),
            )
            fit = fit_tracks(clip, self._head, head_path, self._progress)
            fit.save(folder / TRACKS_FILE)
            return fit.figures

        figures, key = self._stages.run(
            "fit", {"of": inputs, "head": self._head.fingerprint, "camera": list(intrinsics)}, make
        )
        return Fit.load(self._folder / "fit" / TRACKS_FILE, intrinsics, landmarks.size, figures, key)

    def masks(self, landmarks: Landmarks, fit: Fit) -> list[float]:
        """Writes head and mouth masks; returns how much of the mesh lies on the matte, by frame."""
        numbers = list(fit.tracks)
        rows = {number: row for row, number in enumerate(numbers)}
        images = FrameImages(self._folder / FRAMES, numbers)
        mattes = FrameMattes(self._folder / MATTE, numbers)

        def make_heads(folder: Path) -> dict[str, Any]:
            ring = neck_ring(self._head.template.numpy(), self._faces)
            project = fit.projector(self._head)
            overlaps: dict[int, float] = {}

            def one(number: int) -> np.ndarray:
                row = rows[number]
                made = head_mask(images[row], mattes[row], project(number), self._faces, ring)  # type: ignore[arg-type]
                overlaps[number] = made.overlap
                return made.mask

            write_masks(folder, numbers, one, self._progress, "masking the head")
            return {"overlaps": [overlaps[number] for number in numbers]}

        def make_mouths(folder: Path) -> dict[str, Any]:
            def one(number: int) -> np.ndarray:
                return mouth_mask(landmarks.points[number], *landmarks.size)

            write_masks(folder, numbers, one, self._progress, "masking the mouth")
            return {}

        result, _ = self._stages.run(HEAD, {"fit": fit.key}, make_heads)
        self._stages.run(MOUTH, {"fit": fit.key}, make_mouths)
        return result["overlaps"]

    def overlay(self, fit: Fit, look: Look) -> None:
        numbers = list(fit.tracks)
        rows = {number: row for row, number in enumerate(numbers)}
        images = FrameImages(self._folder / FRAMES, numbers)
        heads, mouths = (FrameMattes(self._folder / kind, numbers) for kind in (HEAD, MOUTH))

        def read(number: int) -> FrameParts:
            row = rows[number]
            return FrameParts(images[row], heads[row], mouths[row])  # type: ignore[arg-type]

        def make(folder: Path) -> dict[str, Any]:
            write_overlay(folder, fit.model(self._head), fit.tracks, read, look.landmarks.fps, self._progress)
            return {}

        self._stages.run("overlay", {"fit": fit.key}, make)


def _numbers(landmarks: Landmarks) -> list[int]:
    return np.flatnonzero(landmarks.detected).tolist()


def _camera(focal: Focal, view: View, footage: Footage) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of the view; the principal point is the middle of the source picture."""
    centre = view.to_view(footage.width / 2, footage.height / 2)
    return focal.pixels * view.width / view.box.width, focal.pixels * view.height / view.box.height, *centre


def _matte_network() -> str:
    """The hash of the network that mattes are made with."""
    return (SELFIE_MULTICLASS if find(SELFIE_MULTICLASS) is not None else SELFIE_SEGMENTATION).sha256


def _left_out(look: Look) -> dict[int, str]:
    lost = np.flatnonzero(~look.landmarks.detected).tolist()
    return {n: "no face was found" if look.pictures[n] >= 0 else "the video has no picture at this time" for n in lost}


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
