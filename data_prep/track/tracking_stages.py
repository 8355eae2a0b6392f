"""The stages of one video's tracking: what each is made from, and what it makes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from avatar.data.read_image import read_image, read_mask
from avatar.files.third_party import ThirdPartyFile
from avatar.head.assets import HeadAssets
from data_prep.formats.avatar_track import FRAMES, HEAD, MATTE, MOUTH, TRACKS_FILE
from data_prep.progress import Progress
from data_prep.track.cache_key import head_inputs
from data_prep.track.crop import choose_view
from data_prep.track.faces.landmarks import Landmarks
from data_prep.track.first_pass import FirstPass
from data_prep.track.fit.fit_clip import fit_tracks
from data_prep.track.fit.focal import Focal, choose_focal
from data_prep.track.fit.result import Clip, Fit
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.source import Box, Footage, Span, View
from data_prep.track.frames import (
    ahead,
    frame_file,
    in_view,
    mask_file,
    write_despilled,
    write_frames,
    write_given_mattes,
    write_masks,
)
from data_prep.track.masks.clothes import CLIP_FRAMES, learn_colours
from data_prep.track.masks.head_and_mouth import head_mask, mouth_mask, neck_ring
from data_prep.track.masks.neck_zones import Zones, zones_of
from data_prep.track.mattes import despill
from data_prep.track.mattes.clip_mattes import write_mattes
from data_prep.track.mattes.steadiness import Outline, measure_outline
from data_prep.track.mattes.user_mattes import OwnMattes
from data_prep.track.overlay import FrameParts, write_overlay
from data_prep.track.stage_folder import StageFolder
from data_prep.track.torso import LEAST_FOLLOWED, Picture, TorsoTracker, neck_of, with_torso

DESPILLED = "despilled"  # the stage that stands in for the frames


@dataclass(frozen=True)
class Choices:
    """What a person may say about a video."""

    crop: Literal["auto", "none"] | Box = "auto"
    size: int | None = None  # pixels of the longer side; None for 512 with crop="auto", else the video's
    span: Span = field(default_factory=Span)
    focal: float | None = None  # pixels of the video
    field_of_view: float | None = None  # degrees across the video's width
    matte: Path | None = None  # the user's own: a folder or a video of all pictures
    rotate: int | None = None  # degrees clockwise by which the pictures are turned first; None: as the faces ask for
    camera: tuple[float, float, float, float] | None = None  # calibrated fx, fy, cx, cy in pixels of the video

    def to_json(self) -> dict[str, Any]:
        crop = self.crop if isinstance(self.crop, str) else list(self.crop)
        matte = None if self.matte is None else open_footage(self.matte).content_hash
        return {"crop": crop, "size": self.size, "span": list(self.span), "focal": self.focal,
                "field_of_view": self.field_of_view, "matte": matte, "rotate": self.rotate,
                "camera": self.camera and list(self.camera)}  # fmt: skip


class TrackingStages:
    """The stages of one video; each returns what it found, made now or by an earlier run."""

    def __init__(
        self, folder: StageFolder, footage: Footage, choices: Choices, head: HeadAssets, progress: Progress
    ) -> None:
        self._stages, self._footage, self._choices, self._head = folder, footage, choices, head
        self._progress = progress
        self._folder = folder.path
        self._faces = head.faces.numpy()

    def _image(self, number: int) -> np.ndarray:
        return read_image(frame_file(self._folder / FRAMES, number))

    def _mask(self, number: int, kind: str = MATTE) -> np.ndarray:
        return read_mask(mask_file(self._folder / kind, number))

    def view_and_focal(self, look: FirstPass) -> tuple[View, Focal]:
        points = look.landmarks.points[look.landmarks.detected]
        size = self._footage.width, self._footage.height
        view = choose_view(self._choices.crop, self._choices.size, *size, points)
        if self._choices.camera is not None:
            return view, Focal(self._choices.camera[0], "from the calibration", False)
        given = self._choices.focal, self._choices.field_of_view, self._footage.equivalent_focal
        return view, choose_focal(*size, points, *given)

    def frames(self, look: FirstPass, view: View, inputs: list[Any]) -> str:
        def make(folder: Path) -> dict[str, Any]:
            write_frames(folder, self._footage, view, self._choices.span, look, self._progress)
            return {}

        return self._stages.run(FRAMES, {"of": inputs, "view": [*view.box, view.width, view.height]}, make)[1]

    def mattes(
        self,
        look: FirstPass,
        view: View,
        given: OwnMattes | None,
        network: ThirdPartyFile,
        frames_key: str,
        options: dict[str, Any],
    ) -> tuple[list[int], str]:
        """Returns the frames in which given mattes leave out the face, and the stage's key."""
        numbers = _numbers(look.landmarks)

        def make(folder: Path) -> dict[str, Any]:
            if given is not None:
                span = self._choices.span
                return {"without_face": write_given_mattes(folder, given, view, span, look, self._progress)}
            points = in_view(look.landmarks, view).points[:, :, :2]
            write_mattes(folder, numbers, self._image, points.__getitem__, network, self._progress)
            return {"without_face": []}

        inputs = {"frames": frames_key, "network": network.sha256, "given": options["matte"]}
        result, key = self._stages.run(MATTE, inputs, make)
        return result["without_face"], key

    def despill(self, landmarks: Landmarks, inputs: list[Any]) -> int:
        """Writes the frames without the background's colours on the person, where they reach in so far that it can be seen;
        returns how many pixels, or 0."""
        numbers = _numbers(landmarks)

        def make(folder: Path) -> dict[str, Any]:
            some = numbers[:: -(-len(numbers) // despill.CLIP_FRAMES)]
            width = despill.spill_width((self._image(number), self._mask(number)) for number in some)
            if width:
                write_despilled(folder, numbers, self._image, self._mask, width, self._progress)
            return {"width": width}

        return self._stages.run(DESPILLED, {"of": inputs}, make)[0]["width"]

    def fit(
        self, landmarks: Landmarks, intrinsics: tuple[float, float, float, float], head_path: Path, inputs: list[Any]
    ) -> Fit:
        def make(folder: Path) -> dict[str, Any]:
            clip = Clip(landmarks, intrinsics, self._image, self._mask)
            fit = fit_tracks(clip, self._head, head_path, self._progress)
            fit.save(folder / TRACKS_FILE)
            return fit.figures

        figures, key = self._stages.run(
            "fit", {"of": inputs, "head": head_inputs(head_path, self._head), "camera": list(intrinsics)}, make
        )
        return Fit.load(self._folder / "fit" / TRACKS_FILE, intrinsics, landmarks.size, figures, key)

    def masks(self, landmarks: Landmarks, fit: Fit) -> tuple[list[float], Outline | None]:
        """Writes head and mouth masks; returns how much of the mesh lies on the matte, by frame, and the outline."""
        numbers = list(fit.tracks)

        def make_heads(folder: Path) -> dict[str, Any]:
            ring = neck_ring(self._head.template.numpy(), self._faces)
            project = fit.projector(self._head)
            overlaps: dict[int, float] = {}

            def zones(number: int) -> Zones:
                return zones_of(self._image(number), self._mask(number), project(number), self._faces, ring)

            colours = learn_colours(map(zones, numbers[:: -(-len(numbers) // CLIP_FRAMES)]))

            def one(number: int) -> np.ndarray:
                made = head_mask(self._image(number), self._mask(number), zones(number), colours)
                overlaps[number] = made.overlap
                return made.mask

            write_masks(folder, numbers, one, self._progress, "masking the head")
            is_head = fit.model(self._head).neck()[1].numpy() > 0.5
            outline = measure_outline(numbers, self._mask, lambda number: project(number)[is_head, :2])
            return {"overlaps": [overlaps[number] for number in numbers], "outline": outline}

        def make_mouths(folder: Path) -> dict[str, Any]:
            def one(number: int) -> np.ndarray:
                return mouth_mask(landmarks.points[number], *landmarks.size)

            write_masks(folder, numbers, one, self._progress, "masking the mouth")
            return {}

        result, _ = self._stages.run(HEAD, {"fit": fit.key}, make_heads)
        self._stages.run(MOUTH, {"fit": fit.key}, make_mouths)
        return result["overlaps"], result["outline"] and Outline(*result["outline"])

    def torso(self, fit: Fit) -> Fit:
        """The fit with the torso beneath the head as the clothes show it, by the masks."""

        def make(folder: Path) -> dict[str, Any]:
            neck = neck_of(fit.model(self._head), neck_ring(self._head.template.numpy(), self._faces))
            tracker = TorsoTracker(
                fit.tracks, neck, lambda n: Picture(self._image(n), self._mask(n), self._mask(n, HEAD))
            )
            followed = ahead(list(fit.tracks), tracker.shift, self._progress, "following the torso")
            shifts = [shift for _, shift in followed] if tracker.has_clothes else []
            known = sum(shift is not None for shift in shifts)
            is_followed = known >= LEAST_FOLLOWED * len(fit.tracks)
            tracks = with_torso(fit.tracks, tracker, shifts) if is_followed else fit.tracks
            share = known / len(fit.tracks) if is_followed else 0.0
            figures = fit.figures | {"torso": share if tracker.has_clothes else None}
            Fit(tracks, figures).save(folder / TRACKS_FILE)
            return figures

        figures, key = self._stages.run("torso", {"fit": fit.key}, make)
        first = next(iter(fit.tracks.values()))
        return Fit.load(self._folder / "torso" / TRACKS_FILE, first.intrinsics.tolist(), first.size, figures, key)

    def overlay(self, fit: Fit, look: FirstPass) -> None:
        def read(number: int) -> FrameParts:
            return FrameParts(self._image(number), self._mask(number, HEAD), self._mask(number, MOUTH))

        def make(folder: Path) -> dict[str, Any]:
            write_overlay(folder, fit.model(self._head), fit.tracks, read, look.landmarks.fps, self._progress)
            return {}

        self._stages.run("overlay", {"fit": fit.key}, make)


def _numbers(landmarks: Landmarks) -> list[int]:
    return np.flatnonzero(landmarks.detected).tolist()
