"""`avatar track` of several calibrated cameras: the front one is tracked, the others tell the scale and the distance.

front      the front camera's tracked folder
images     every camera's pictures at the wanted size, and the landmarks in them
fg_masks   head and neck in each of them
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avatar.data.read_image import read_image
from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.head.normals import vertex_normals
from data_prep.formats.avatar_track import TRACKS_FILE, read_info, read_tracks
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.camera_rig import Pose
from data_prep.prepare.projection import head_params, project_head
from data_prep.progress import Progress, silent
from data_prep.track.cache_key import look_inputs, tracking_key
from data_prep.track.camera_rig import gha_folder, recording
from data_prep.track.camera_rig.camera_pictures import Times, copy_mattes, detection_view, find_front, write_pictures
from data_prep.track.camera_rig.head_mattes import MatteClip, front_colours, write_head_mattes
from data_prep.track.camera_rig.place_head import Points, View, place_head, refuse_misfit
from data_prep.track.camera_rig.recording import MAX_DIFFERENCE, Camera, Recording
from data_prep.track.camera_rig.vhap_listing import IMAGES, MATTES, PARAMETERS, lens_in, write_listing, write_parameters
from data_prep.track.faces.embedding import LandmarkEmbedding
from data_prep.track.fit.fit_clip import find_embedding
from data_prep.track.footage.source import MIN_SIDE, Span, check_span, whole
from data_prep.track.frames import frame_file
from data_prep.track.masks.clothes import Colours
from data_prep.track.mattes.segmentation_network import matte_network
from data_prep.track.stage_folder import StageFolder, growing, hash_of, writing
from data_prep.track.track import track
from data_prep.track.tracking_stages import Choices

DEFAULT_SIZE = 802  # pixels of the longer side, as GaussianAvatars' data set has
FRONT, WHOLE = "front", Span()
HELD_OUT = "FREE"  # NeRSemble's sequence that is not trained on
_LANDMARKS = 120  # of which the scale is found; the others say the same


def recognise(folder: Path) -> bool:
    return any(layout.recognise(folder) for layout in (recording, gha_folder))


def track_rig(
    folders: Sequence[Path],
    out: Path,
    head_path: Path,
    head: HeadAssets,
    size: int | None = None,
    span: Span = WHOLE,
    say: Callable[[str], object] = print,
    progress: Progress = silent,
) -> None:
    """Track a recording and write a folder in VHAP's layout, of pictures with `size` on the longer side.

    folders  the recording; or sequences of one person beside each other, which get one identity and one scale. Those
             called FREE are listed for testing.

    Goes on from the stages of an interrupted call, as `track` does. Raises UserError, with what to do, where cameras and
    calibration do not belong together or show no face, and where `out` is not empty.
    """
    if size is not None and not MIN_SIDE <= size <= 4096:
        raise UserError(f"--size must be from {MIN_SIDE} to 4096 pixels, not {size}")
    if out.exists() and any(out.iterdir()):
        raise UserError(f"{out} is not empty: choose another --out, or remove it first")
    opened = _open(folders)
    if opened.sequences and span != WHOLE:
        raise UserError("--start and --end are of one sequence: leave them out, or track the sequences by themselves")
    folder, in_every = opened.folder, " in every sequence" if opened.sequences else ""
    if len(opened.cameras) < 2:
        raise UserError(
            f"{folder} has pictures of {'one' if opened.cameras else 'no'} calibrated camera{in_every}; two at least tell "
            "the head's size from its distance: copy the others, or track a video alone"
        )
    check_span(span, min((d for c in opened.cameras.values() if (d := c.footage.duration) is not None), default=None))
    if opened.unused:
        say(f"note: calibrated cameras without pictures{in_every} are left out: {', '.join(opened.unused)}")
    front = find_front(opened, span)
    say(f"{folder}: {len(opened.cameras)} cameras; the front one is {front}")
    with growing(out) as stages:
        rig = _RigTracking(stages, opened, front, head_path, head, size or DEFAULT_SIZE)
        tracks, times, front_key = rig.track_front(span, say, progress)
        embedding = _some(find_embedding(head_path, head))
        looks = {serial: rig.look(serial, times, embedding.landmarks, front_key, progress) for serial in opened.cameras}
        _refuse_gaps(opened, {serial: len(found) for serial, (found, _) in looks.items()}, len(tracks))
        tracks = {n: track for n, track in tracks.items() if all(n in found for found, _ in looks.values())}
        views = {s: rig.view(s, [found[n] for n in tracks], len(embedding)) for s, (found, _) in looks.items()}
        model = _model(head, tracks)
        points = _points(model, tracks, embedding)
        placed = place_head(points, views)
        unused = ", ".join(serial for serial in views if serial not in placed.cameras)
        say(
            f"the calibration is scaled by {placed.scale:.4g}, by landmarks in {len(placed.cameras)} of {len(views)} "
            f"cameras{f' (not {unused})' if unused else ''}; their median error falls from "
            f"{placed.before:.1f} to {placed.after:.1f} pixels"
        )
        refuse_misfit(placed, views, folder)
        colours = front_colours(stages.path / FRONT, tracks, model)
        tracks = {n: placed.moved(row, track, points.centres[row]) for row, (n, track) in enumerate(tracks.items())}
        times = times._replace(numbers=list(tracks))
        for serial in opened.cameras:
            rig.mattes(serial, tracks, placed.scale, times, colours, embedding, looks[serial][1], progress)
        tested = _held_out(opened, times, say)
        rig.write(tracks, placed.scale, times.fps, tested)
        stages.finish(out, ())
    say(f"tracked {len(tracks)} times of {len(opened.cameras)} cameras in {out}")


class _RigTracking:
    """The stages; `tracks` are of the front camera, by time."""

    def __init__(
        self, stages: StageFolder, opened: Recording, front: str, head_path: Path, head: HeadAssets, size: int
    ) -> None:
        self._stages, self._cameras, self._front = stages, opened.cameras, front
        self._head_path, self._head = head_path, head
        self._views = {s: whole(c.footage.width, c.footage.height, size) for s, c in opened.cameras.items()}

    def track_front(
        self, span: Span, say: Callable[[str], object], progress: Progress
    ) -> tuple[dict[int, FrameTrack], Times, str]:
        """The tracks, the times, and the stage's key."""
        camera = self._cameras[self._front]
        fx, fy, cx, cy = camera.intrinsics.tolist()
        choices = Choices(span=span, rotate=0, camera=(fx, fy, cx, cy))

        def make(folder: Path) -> dict[str, Any]:
            def say_front(words: str) -> None:
                say(words.replace(str(folder), FRONT))  # not the hidden folder

            folder.rmdir()
            track(camera.footage, folder, self._head_path, self._head, choices, say_front, progress)
            return {}

        inputs = {"of": tracking_key(camera.footage, choices.to_json(), self._head_path, self._head)}
        _, key = self._stages.run(FRONT, inputs, make)
        info = read_info(self._stages.path / FRONT)
        tracks = read_tracks(self._stages.path / FRONT, TRACKS_FILE, say).frames
        return tracks, Times(list(tracks), float(info.source["begins"]), info.fps), key

    def look(
        self, serial: str, times: Times, landmarks: np.ndarray, front_key: str, progress: Progress
    ) -> tuple[dict[int, np.ndarray | None], str]:
        """The landmarks [L, 2] of each time that has a picture, or None; and the stage's key."""
        camera, view = self._cameras[serial], self._views[serial]

        def make(folder: Path) -> dict[str, Any]:
            timed = progress(
                times.pick(camera.footage, detection_view(view, camera.footage)), len(times.numbers), f"camera {serial}"
            )
            return {"found": write_pictures(folder, timed, view, landmarks)}

        inputs = {"front": front_key, "of": look_inputs(camera.footage), "view": [view.width, view.height]}
        result, key = self._stages.run(f"{IMAGES}/{serial}", inputs, make)
        return {int(n): None if found is None else np.array(found) for n, found in result["found"].items()}, key

    def view(self, serial: str, found: Sequence[np.ndarray | None], count: int) -> View:
        """What the scale is found from; `count` landmarks each."""
        points = np.stack([np.full((count, 2), np.nan) if one is None else one for one in found])
        away = _pose(self._cameras[serial]).after(_pose(self._cameras[self._front]).inverse())
        return View(away.R, away.t, lens_in(self._cameras[serial], self._views[serial]), points)

    def mattes(
        self, serial: str, tracks: Mapping[int, FrameTrack], scale: float, times: Times, colours: Colours | None,
        embedding: LandmarkEmbedding, key: str, progress: Progress,
    ) -> None:  # fmt: skip
        camera, view, model = self._cameras[serial], self._views[serial], _model(self._head, tracks)
        lens, images = lens_in(camera, view), self._stages.path / IMAGES / serial
        front = _pose(self._cameras[self._front], scale)
        away = _pose(camera, scale).after(front.inverse())

        def screen(number: int) -> np.ndarray:
            seen = away.after(Pose(tracks[number].R, tracks[number].t))
            track = replace(tracks[number], R=seen.R, t=seen.t, size=(view.width, view.height))
            return project_head(model, track, lens, view.width, view.height)

        def make(folder: Path) -> dict[str, Any]:
            if camera.mattes is not None:
                copy_mattes(folder, camera.mattes, view, times)
            clip = MatteClip(times.numbers, lambda n: read_image(frame_file(images, n)), screen)
            write_head_mattes(folder, clip, self._head, colours, embedding, network, progress)
            return {}

        network, given = matte_network(), camera.mattes and camera.mattes.content_hash
        poses = hash_of([[*track.moving_values()] for track in tracks.values()])
        seen = [*away.R.ravel().tolist(), *away.t.tolist(), *lens.tolist()]
        inputs = {"images": key, "network": network.sha256, "given": given, "poses": poses, "camera": seen}
        self._stages.run(f"{MATTES}/{serial}", inputs, make)

    def write(self, tracks: Mapping[int, FrameTrack], scale: float, fps: float, tested: Collection[int] = ()) -> None:
        out, to_world = self._stages.path, _pose(self._cameras[self._front], scale).inverse()
        with writing(out):
            self._remove_others()
            write_parameters(out, tracks, to_world, self._head)
            write_listing(out, self._cameras, self._views, list(tracks), scale, fps, tested)

    def _remove_others(self) -> None:
        """What earlier calls made of cameras that are not there now, and the heads that they wrote."""
        for kind in (IMAGES, MATTES):
            for path in (self._stages.path / kind).iterdir():
                if path.name not in self._cameras:
                    shutil.rmtree(path)
        shutil.rmtree(self._stages.path / PARAMETERS, ignore_errors=True)
        for path in self._stages.path.glob("transforms*.json"):
            path.unlink()


def _open(folders: Sequence[Path]) -> Recording:
    if len(folders) == 1:
        return (recording if recording.recognise(folders[0]) else gha_folder).open_recording(folders[0])
    for folder in folders:
        if not recording.recognise(folder):
            raise UserError(f"{folder} has no images/cam_SERIAL.mp4: only sequences of NeRSemble are tracked together")
    return recording.join_recordings([recording.open_recording(folder) for folder in folders])


def _held_out(opened: Recording, times: Times, say: Callable[[str], object]) -> set[int]:
    """Times of the sequences that are called FREE, where there are others."""
    free = {name for name, _ in opened.sequences if name.upper().startswith(HELD_OUT)}
    begins = [seconds for _, seconds in opened.sequences]
    rows = np.searchsorted(begins, [times.seconds(number + 0.5) for number in times.numbers], "right") - 1
    tested: set[int] = set()
    for row, (name, _) in enumerate(opened.sequences):
        own = [number for number, place in zip(times.numbers, rows, strict=True) if place == row]
        is_tested = name in free and len(free) < len(opened.sequences)
        say(f"{name}: {f'times {own[0]} to {own[-1]}' if own else 'no times'}{', held out' if is_tested else ''}")
        tested |= {*own} if is_tested else set()
    return tested


def _pose(camera: Camera, scale: float = 1.0) -> Pose:
    """From the world to the camera."""
    return Pose(camera.R, scale * camera.t)


def _some(embedding: LandmarkEmbedding) -> LandmarkEmbedding:
    rows = np.linspace(0, len(embedding) - 1, min(len(embedding), _LANDMARKS)).round().astype(int)
    return LandmarkEmbedding(embedding.landmarks[rows], embedding.corners[rows], embedding.barycentric[rows])


def _model(head: HeadAssets, tracks: Mapping[int, FrameTrack]) -> HeadModel:
    return HeadModel(head, torch.from_numpy(next(iter(tracks.values())).shape).float())


def _points(model: HeadModel, tracks: Mapping[int, FrameTrack], embedding: LandmarkEmbedding) -> Points:
    def on(values: Tensor) -> np.ndarray:
        return np.einsum("lk,lkc->lc", embedding.barycentric, values.double().numpy()[embedding.corners])

    posed = [model.vertices(head_params(one)) for one in tracks.values()]
    positions = np.stack([on(vertices) for vertices in posed])
    normals = np.stack([on(vertex_normals(vertices, model.faces)) for vertices in posed])
    turns, means = np.stack([one.R for one in tracks.values()]), positions.mean(1)
    centres = np.stack([R @ mean + one.t for R, mean, one in zip(turns, means, tracks.values(), strict=True)])
    return Points(positions - means[:, None], normals, turns, centres)


def _refuse_gaps(opened: Recording, counts: Mapping[str, int], wanted: int) -> None:
    short = min(counts, key=counts.__getitem__)
    if counts[short] < wanted - MAX_DIFFERENCE:
        raise UserError(
            f"{opened.cameras[short].footage.path} has pictures at {counts[short]} of the {wanted} times of the front "
            "camera: it is damaged or has another rate; copy it again, or convert all cameras to one rate"
        )
