"""Findings about several cameras: where each stands, whether it moves, and whether its clock is that of the others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from data_prep.check.clip import Clip
from data_prep.check.findings import Finding, frames_phrase
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.frame_files import FrameFiles
from data_prep.formats.frame_track import FrameTrack, Tracking, fit_coefficients
from data_prep.formats.tracked_folder import Shot, TrackedFolder
from data_prep.prepare.camera_rig import find_rig
from data_prep.prepare.check_alignment import refuse_misplaced_cameras
from data_prep.prepare.frame_offset import MIN_FRAMES, detect_offset


def check_cameras(clip: Clip, assets: HeadAssets, size: tuple[int, int]) -> list[Finding]:
    """On all cameras of a clip, which holds one of them; empty where there is one.

    size  of the images, where the listing does not say it
    """
    given = clip.given
    source = open_tracked_folder(given.folder, given.tracking, given.data_format, lambda _: None, given.cameras)
    if not source.shots:
        return []
    findings: list[Finding] = []
    try:
        tracking = source.read(assets, size, lambda _: None)
        findings += _unusable(source, tracking, clip)
        if tracking.frames:
            tracking = fit_coefficients(tracking, assets)
    except UserError as error:
        return [*findings, Finding("error", "camera", str(error), "mend it, or leave cameras out with --cameras")]
    tracks = {n: track for n, track in tracking.frames.items() if source.files.images[n].is_file()}
    if not tracks:
        return findings
    head = HeadModel(assets, torch.from_numpy(next(iter(tracks.values())).shape))
    return [*findings, *_poses(source, tracks, head), *_clocks(source, tracks, head)]


def _unusable(source: TrackedFolder, tracking: Tracking, clip: Clip) -> Iterator[Finding]:
    """Tracking that cannot be used in other cameras than the clip's, whose own findings name parameters of all cameras."""
    images = set(clip.files.images.values())
    parameters = {clip.tracking.paths[number] for number in clip.tracking.bad}
    of_camera: dict[str, list[int]] = {}
    for number in tracking.bad:
        if source.files.images[number] not in images and tracking.paths[number] not in parameters:
            of_camera.setdefault(source.shots[number].camera, []).append(number)
    names = source.files.frame_names()
    for camera, numbers in of_camera.items():
        yield Finding(
            clip.loss_severity(len(tracking.bad), len(source.files.images)),
            "tracking",
            f"the tracking of camera {camera} cannot be used in {frames_phrase(numbers, names.__getitem__)}: "
            f"{tracking.bad[numbers[0]]}",
            "export these frames again, or leave the camera out with --cameras",
            tuple(names[number] for number in numbers),
        )


def _poses(source: TrackedFolder, tracks: dict[int, FrameTrack], head: HeadModel) -> Iterator[Finding]:
    shots = {number: source.shots[number] for number in tracks}
    try:
        find_rig(list(shots.values()), list(tracks.values()))
    except UserError as error:
        yield Finding("error", "camera-moves", str(error), "calibrate it again, or leave it out with --cameras")
    for camera in sorted({shot.camera for shot in shots.values()}):
        own = {number: shot for number, shot in shots.items() if shot.camera == camera}
        try:
            refuse_misplaced_cameras(head, tracks, source.files, [(number, number) for number in own], own)
        except UserError as error:
            yield Finding("error", "camera-pose", str(error), "calibrate it again, or leave it out with --cameras")


def _clocks(source: TrackedFolder, tracks: dict[int, FrameTrack], head: HeadModel) -> Iterator[Finding]:
    """Each camera by itself, its pictures numbered by time: masks and mesh tell by how many they are apart."""
    for camera in sorted({source.shots[number].camera for number in tracks}):
        own = {number: source.shots[number] for number in tracks if source.shots[number].camera == camera}
        if len(own) < MIN_FRAMES:
            continue
        files = _by_time(source.files, own)
        try:
            found = detect_offset(head, {own[n].time: tracks[n] for n in own}, files, ignore_misfit=True)
        except UserError:
            continue  # nothing moves enough to tell
        if found.offset:
            late = "late" if found.offset > 0 else "early"
            yield Finding(
                "warning",
                "camera-clock",
                f"the pictures of camera {camera} are {abs(found.offset)} frames {late} against the tracking: "
                f"{found.sentence()}",
                "synchronise the cameras again, or leave this one out with --cameras",
            )


def _by_time(files: FrameFiles, shots: dict[int, Shot]) -> FrameFiles:
    numbered = {
        kind: {shots[number].time: path for number, path in getattr(files, kind).items() if number in shots}
        for kind in ("images", "alphas", "head_masks", "mouth_masks", "tracking", "parsing")
    }
    return replace(files, **numbered)
