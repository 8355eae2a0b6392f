"""Findings about several cameras: their pictures, where each stands, whether it moves, and whether its clock is that of
the others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import torch

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from data_prep.check.check_fit import IGNORED
from data_prep.check.clip import Clip
from data_prep.check.findings import Finding, Severity, frames_phrase, from_sentence
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.frame_files import IMAGE, TRACKING, FrameFiles
from data_prep.formats.frame_track import FrameTrack, Tracking, fit_coefficients
from data_prep.formats.tracked_folder import TrackedFolder
from data_prep.prepare.camera_rig import find_rig
from data_prep.prepare.check_alignment import refuse_misplaced_cameras
from data_prep.prepare.dark_cameras import refuse_dark_cameras
from data_prep.prepare.frame_offset import detect_offset
from data_prep.prepare.inspect_images import check_sizes, inspect_images
from data_prep.prepare.mask_values import with_labels
from data_prep.prepare.pairing import grouped

LEAVE_OUT = "leave it out with --cameras"


def check_cameras(clip: Clip, assets: HeadAssets, size: tuple[int, int]) -> list[Finding]:
    """On all cameras of a clip, which holds one of them; empty where there is one.

    size  of the images, where the listing does not say it
    """
    given = clip.given
    source = open_tracked_folder(given.folder, given.tracking, given.data_format, lambda _: None, given.cameras)
    if not source.shots:
        return []
    files, _ = with_labels(source.files, source.shots)
    source = replace(source, files=files)
    unread = {path for number, path in clip.files.images.items() if not clip.is_whole(number)}
    bad: dict[int, str] = {}
    findings: list[Finding] = []
    try:
        complaints: list[str] = []
        tracking = source.read(assets, size, complaints.append)
        if not any(check == "tracking" for check, _ in clip.complaints):  # else they may be of the clip's own camera
            findings += [from_sentence("camera", sentence) for sentence in complaints]
        findings += _unusable(source, tracking, clip)
        own = set(clip.files.images.values())  # whose findings are made elsewhere
        others = _with_files(files, {number: number for number, path in files.images.items() if path not in own})
        if others.images:
            seen = inspect_images(others, source.shots)
            bad = _lacking(files, clip) | seen.bad
            severity = clip.loss_severity(len(bad) + len(unread), len(files.images))
            findings += _by_camera(source, bad, severity, "unreadable", "pictures or masks")
            check_sizes(files, tracking, seen, is_rig=True)
        if tracking.frames:
            tracking = fit_coefficients(tracking, assets)
    except UserError as error:
        return [*findings, Finding("error", "camera", str(error), "mend it, or leave cameras out with --cameras")]
    tracks = {n: track for n, track in tracking.frames.items() if n not in bad and files.images[n] not in unread}
    if not tracks:
        return findings
    head = HeadModel(assets, torch.from_numpy(next(iter(tracks.values())).shape))
    return [
        *findings,
        *_dark(source, tracks),
        *_poses(source, tracks, head, given.ignore_misfit),
        *_clocks(source, tracks, head),
    ]


def _lacking(files: FrameFiles, clip: Clip) -> dict[int, str]:
    """Image number -> that it has no file of a kind of which others have some. `check_files` tells of the clip's own, where
    it has any of that kind."""
    told = {kind for kind, found in clip.files.of_kind().items() if found}
    own = set(clip.files.images.values())
    return {
        number: f"it has no file in {files.title(kind)}"
        for kind, found in files.of_kind().items()
        for number, path in files.images.items()
        if found and kind not in (IMAGE, TRACKING) and number not in found and not (kind in told and path in own)
    }


def _unusable(source: TrackedFolder, tracking: Tracking, clip: Clip) -> Iterator[Finding]:
    """Tracking that cannot be used in other cameras than the clip's, whose own findings name parameters of all cameras."""
    images = set(clip.files.images.values())
    parameters = {clip.tracking.paths[number] for number in clip.tracking.bad}
    reasons = {
        number: reason
        for number, reason in tracking.bad.items()
        if source.files.images[number] not in images and tracking.paths[number] not in parameters
    }
    severity = clip.loss_severity(len(tracking.bad), len(source.files.images))
    return _by_camera(source, reasons, severity, "tracking", "the tracking")


def _by_camera(
    source: TrackedFolder, reasons: Mapping[int, str], severity: Severity, check: str, what: str
) -> Iterator[Finding]:
    """A finding for each camera of which something cannot be used, with the first of the reasons."""
    names = source.files.frame_names()
    for camera, numbers in grouped({number: source.shots[number].camera for number in reasons}).items():
        yield Finding(
            severity,
            check,
            f"{what} of camera {camera} cannot be used in {frames_phrase(numbers, names.__getitem__)}: "
            f"{reasons[numbers[0]]}",
            "export these frames again, or leave the camera out with --cameras",
            tuple(names[number] for number in numbers),
        )


def _dark(source: TrackedFolder, tracks: dict[int, FrameTrack]) -> Iterator[Finding]:
    try:
        refuse_dark_cameras(source.files, [(number, number) for number in tracks], source.shots)
    except UserError as error:
        yield from_sentence("camera-dark", str(error))


def _poses(
    source: TrackedFolder, tracks: dict[int, FrameTrack], head: HeadModel, ignore_misfit: bool
) -> Iterator[Finding]:
    shots = {number: source.shots[number] for number in tracks}
    try:
        find_rig(list(shots.values()), list(tracks.values()))
    except UserError as error:
        yield Finding("error", "camera-moves", str(error), f"calibrate it again, or {LEAVE_OUT}")
    for camera in sorted({shot.camera for shot in shots.values()}):
        own = {number: shot for number, shot in shots.items() if shot.camera == camera}
        try:
            refuse_misplaced_cameras(head, tracks, source.files, [(number, number) for number in own], own)
        except UserError as error:
            severity, advice = (
                ("warning", IGNORED) if ignore_misfit else ("error", f"calibrate it again, or {LEAVE_OUT}")
            )
            yield Finding(severity, "camera-pose", str(error), advice)


def _clocks(source: TrackedFolder, tracks: dict[int, FrameTrack], head: HeadModel) -> Iterator[Finding]:
    """Each camera by itself, its pictures numbered by time: masks and mesh tell by how many they are apart."""
    for camera in sorted({source.shots[number].camera for number in tracks}):
        own = {number: source.shots[number] for number in tracks if source.shots[number].camera == camera}
        files = _with_files(source.files, {number: shot.time for number, shot in own.items()})
        try:
            found = detect_offset(head, {own[n].time: tracks[n] for n in own}, files, ignore_misfit=True)
        except UserError:
            continue  # too few, or nothing moves enough to tell
        if found.offset:
            late = "late" if found.offset > 0 else "early"
            yield Finding(
                "warning",
                "camera-clock",
                f"the pictures of camera {camera} are {abs(found.offset)} frames {late} against the tracking: "
                f"{found.sentence()}",
                "synchronise the cameras again, or leave this one out with --cameras",
            )


def _with_files(files: FrameFiles, numbers: Mapping[int, int]) -> FrameFiles:
    """Those of the frames in `numbers` alone, each under its new number."""
    kept: dict[str, dict[int, Path]] = {
        kind: {numbers[number]: path for number, path in getattr(files, kind).items() if number in numbers}
        for kind in ("images", "alphas", "head_masks", "mouth_masks", "tracking", "parsing")
    }
    return replace(files, **kept)
