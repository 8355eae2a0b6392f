"""Tracked folder -> prepared subject: check, find the offset, pair, and write manifest and tracks. Cached by its inputs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from avatar.data.manifest import GIVEN, MASKS, FrameRecord, Manifest
from avatar.data.source import DEFAULT_FPS, Source
from avatar.errors import UserError, refuse
from avatar.files.names import display_name, safe_name
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.frame_files import ALPHA, HEAD, MOUTH, FrameFiles
from data_prep.formats.frame_track import FrameTrack, Tracking, fit_coefficients
from data_prep.formats.tracked_folder import Shot, TrackedFolder
from data_prep.formats.train_test_split import split_frames_of
from data_prep.prepare.cache import default_location, input_hash
from data_prep.prepare.camera_rig import FoundCameras, Pose, find_rig, heads_before
from data_prep.prepare.check_alignment import check_sample, refuse_misplaced_cameras
from data_prep.prepare.constant_parameters import constant_parameters
from data_prep.prepare.dark_cameras import refuse_dark_cameras
from data_prep.prepare.frame_offset import detect_offset
from data_prep.prepare.inspect_images import Inspection, check_sizes, composited_background, inspect_images
from data_prep.prepare.mask_polarity import polarity_problems
from data_prep.prepare.mask_values import with_labels
from data_prep.prepare.masks import derive_masks
from data_prep.prepare.pairing import Pairing, describe_reasons, pair_frames, refuse_if_many
from data_prep.prepare.projection import lip_faces
from data_prep.prepare.write_prepared import HEAD_FOLDER, MOUTH_FOLDER, is_current, write_prepared
from data_prep.prepare.wrong_inputs import check_numbers


def prepare(
    source: Source,
    head: HeadAssets,
    *,
    out: Path | str | None = None,
    test_frames: int | None = None,
    test_cameras: str | None = None,
    say: Callable[[str], object] = print,
) -> Path:
    """Prepare a tracked folder and return the prepared subject's folder; nothing is done when it is up to date.

    `head` is the head model that `source.head` names; `out` defaults to a folder in the cache (see `cache_folder`). `say`
    receives one sentence per finding. `test_frames` and `test_cameras` say what is held out (`split_frames_of`). Raises
    UserError with the file or frame and what to do when the folder cannot be used.
    """
    folder = Path(source.folder).resolve()
    check_numbers(source)
    tracking = None if source.tracking is None else Path(source.tracking).resolve()
    tracked = open_tracked_folder(folder, tracking, source.data_format, cameras=source.cameras)
    files = tracked.files
    options = {
        "offset": source.frame_offset,
        "format": tracked.format,
        "test_frames": test_frames,
        "cameras": source.cameras,
        "test_cameras": test_cameras,
        "fps": source.fps,
        "max_left_out": source.max_left_out,
        "ignore_misfit": source.ignore_misfit,
        "head": head.fingerprint,
    }
    head_path = str(Path(source.head).resolve())
    inputs = input_hash(files, options | {"head_path": head_path})
    target = Path(out).resolve() if out is not None else default_location(folder, files, options)
    if is_current(target, inputs, is_chosen=out is not None, say=say):
        say(f"using the prepared subject {target}")
        return target

    say(f"format: {tracked.format}")
    files, label_notes = with_labels(files, tracked.shots)
    inspection = inspect_images(files, tracked.shots)
    refuse_if_many(inspection.bad, len(files.images), "images", source.max_left_out)
    tracks = tracked.read(head, (inspection.width, inspection.height), refuse)
    refuse_if_many(tracks.bad, len(files.tracking), "tracking files", source.max_left_out)
    if not tracks.frames:
        raise UserError(
            f"no frame has tracking that can be used: {describe_reasons(tracks.bad)}; track the video again"
        )
    tracks = fit_coefficients(tracks, head)
    first = next(iter(tracks.frames.values()))
    check_sizes(files, tracks, inspection, bool(tracked.shots))
    model = HeadModel(head, torch.from_numpy(first.shape))
    if not source.ignore_misfit:
        shots, unread = tracked.shots, inspection.bad
        for problem in polarity_problems(model, tracks.frames, files, source.max_left_out, unread, shots):
            refuse(problem)
    offset, evidence = _find_offset(replace(tracked, files=files), model, tracks, inspection, source, say)
    centre = model.neutral_vertices().mean(0).numpy()
    pairing = pair_frames(files, inspection, tracks, offset, centre, source.max_left_out, tracked.shots)
    alignment = check_sample(model, tracks.frames, files, pairing.pairs)
    if not source.ignore_misfit:
        alignment.refuse()
        refuse_misplaced_cameras(model, tracks.frames, files, pairing.pairs, tracked.shots)
    refuse_dark_cameras(files, pairing.pairs, tracked.shots)
    evidence = f"{evidence}: {alignment.evidence}"
    say(evidence)
    has_lips = len(lip_faces(model)) > 0
    frames_split, split_notes = split_frames_of(
        tracked, [number for _, number in pairing.pairs], test_frames, test_cameras
    )
    ignored = [f"{alignment.problem}: taken regardless, as --ignore-misfit says"] if alignment.problem else []
    parts = constant_parameters(_of_one_camera(tracks, pairing, tracked.shots), head)
    still = [part.sentence for part in parts if not part.is_absent]
    assumed = _assumptions(files, inspection, has_lips)
    notes = [
        *ignored,
        *tracked.notes,
        *label_notes,
        *inspection.notes,
        *tracks.notes,
        *tracks.flaws,
        *pairing.notes,
        *still,
        *alignment.notes,
        *assumed,
        *split_notes,
    ]
    for note in notes:
        say(f"note: {note}")
    names = files.frame_names()
    if pairing.left_out:
        total = len(pairing.pairs) + len(pairing.left_out)
        reasons = describe_reasons(pairing.left_out, names.__getitem__)
        say(f"warning: left out {len(pairing.left_out)} of {total} frames: {reasons}")
    used = [tracks.frames[number] for _, number in pairing.pairs]
    shots = [tracked.shots[image] for image, _ in pairing.pairs if tracked.shots]
    found = find_rig(shots, used) if shots else None
    arrays = _stack_tracks(used) if found is None else _stack_tracks(found.rows, found.heads)
    if tracked.read_given is not None:
        given_tracks = fit_coefficients(tracked.read_given(refuse), head)
        rows = [given_tracks.frames[number] for _, number in pairing.pairs]
        given = _stack_tracks(rows) if found is None else _stack_tracks(*heads_before(found.rig, rows))
        arrays |= {f"{GIVEN}{name}": array for name, array in given.items()}
    head_kind = "source" if files.head_masks else "derived" if files.parsing else "none"
    mouth_kind = "source" if files.mouth_masks else "derived" if files.parsing or has_lips else "none"
    manifest = Manifest(
        name=safe_name(display_name(folder)),
        format=tracked.format,
        source=str(files.folder),
        tracking=str(next(iter(files.tracking.values())).parent),
        width=first.size[0] if found is None else found.rig.cameras[0].width,
        height=first.size[1] if found is None else found.rig.cameras[0].height,
        fps=float(source.fps or tracked.fps or DEFAULT_FPS),
        intrinsics=tuple(first.intrinsics.tolist()) if found is None else found.rig.cameras[0].intrinsics,
        frame_offset=offset,
        offset_evidence=evidence,
        frames=_records(files, names, pairing, head_kind, mouth_kind, tracked.shots),
        train=frames_split.train,
        test=frames_split.test,
        left_out={names[n]: reason for n, reason in pairing.left_out.items()},
        notes=tuple(notes),
        head_masks=head_kind,
        mouth_masks=mouth_kind,
        head_path=head_path,
        head_fingerprint=head.fingerprint,
        input_hash=inputs,
        data_hash=_data_hash(inspection, pairing, arrays, first.intrinsics, found),
        refinement=tracked.refinement,
        rig=None if found is None else found.rig,
        labels={
            mask: files.labels[kind]
            for mask, kind in zip(MASKS, (ALPHA, HEAD, MOUTH), strict=True)
            if kind in files.labels
        },
    )
    write_prepared(
        target, manifest, arrays, lambda building: derive_masks(building, manifest, files, model, tracks, pairing.pairs)
    )
    assumed_rate = "" if source.fps or tracked.fps else " (assumed; --fps says otherwise)"
    say(
        f"prepared {len(manifest.frames)} frames ({len(manifest.train)} train, {len(manifest.test)} test), "
        f"{manifest.fps:g} a second{assumed_rate}, in {target}"
    )
    return target


def _find_offset(
    tracked: TrackedFolder,
    model: HeadModel,
    tracks: Tracking,
    inspection: Inspection,
    source: Source,
    say: Callable[[str], object],
) -> tuple[int, str]:
    """The offset (image number - tracking number) and a sentence on how it was found."""
    files, given = tracked.files, source.frame_offset
    tracked.refuse_offset(given)
    if tracked.is_paired:
        return 0, f"images and tracking are paired by {files.pairing}"
    try:
        estimate = detect_offset(model, tracks.frames, files, inspection.bad, source.ignore_misfit)
        if given is None:
            return estimate.offset, estimate.sentence()
        if contradiction := estimate.against(given):
            say(f"warning: {contradiction}; leave it out to use that one")
    except UserError:  # the frames do not say
        if given is None:
            raise
    return given, f"image offset {given}, given with --frame-offset"


def _assumptions(files: FrameFiles, inspection: Inspection, has_lips: bool) -> list[str]:
    notes = []
    if not files.alphas:
        notes.append(f"there is no {files.names.alphas}: the whole image is taken as foreground")
    if not files.head_masks and not files.parsing:
        taken = "the foreground matte" if files.alphas else "the whole image"
        notes.append(f"there are no {files.names.head_masks}: {taken} is taken as the head")
    if not files.mouth_masks and not files.parsing:
        made = "masks of the projected lips are made" if has_lips else "the head model has no lips, so no mouth weight"
        notes.append(f"there are no {files.names.mouth_masks}: {made}")
    # A PNG has its colours beside its transparency, not multiplied by it, whatever lies under the transparent pixels.
    is_matted = files.alphas and not files.is_transparent
    colour = composited_background(files, inspection.bad) if is_matted else None
    if colour is not None:
        notes.append(
            f"the images seem to be composited on {colour} already: compositing them again with their matte squares it at "
            "the edges"
        )
    return notes


def _stack_tracks(used: Sequence[FrameTrack], heads: Sequence[Pose] | None = None) -> dict[str, np.ndarray]:
    """The tracks of a recording: `heads` in place of the frames' own poses, where they are given."""
    moving = ("expression", "jaw", "eyes", "eyelids", "neck", "R", "t")
    arrays = {name: np.stack([getattr(track, name) for track in used]) for name in moving}
    if heads is not None:
        arrays |= {"R": np.stack([head.R for head in heads]), "t": np.stack([head.t for head in heads])}
    arrays["shape"] = used[0].shape
    return {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in sorted(arrays.items())}


def _records(
    files: FrameFiles,
    names: dict[int, str],
    pairing: Pairing,
    head_kind: str,
    mouth_kind: str,
    shots: Mapping[int, Shot],
) -> tuple[FrameRecord, ...]:
    def inside(paths: dict[int, Path], number: int) -> str | None:
        return paths[number].relative_to(files.folder).as_posix() if paths else None

    def mask(kind: str, folder: str, paths: dict[int, Path], number: int) -> str | None:
        return f"{folder}/{number:05d}.png" if kind == "derived" else inside(paths, number)

    return tuple(
        FrameRecord(
            name=names[image],
            image=files.images[image].relative_to(files.folder).as_posix(),
            tracking=shots[image].time if shots else number,
            alpha=inside(files.alphas, image),
            head_mask=mask(head_kind, HEAD_FOLDER, files.head_masks, image),
            mouth_mask=mask(mouth_kind, MOUTH_FOLDER, files.mouth_masks, image),
        )
        for image, number in pairing.pairs
    )


def _of_one_camera(tracks: Tracking, pairing: Pairing, shots: Mapping[int, Shot]) -> list[FrameTrack]:
    """The tracks of all frames; with several cameras of those of the first one."""
    first = next(iter(shots.values())).camera if shots else None
    return [tracks.frames[n] for image, n in pairing.pairs if first is None or shots[image].camera == first]


def _data_hash(
    inspection: Inspection,
    pairing: Pairing,
    arrays: dict[str, np.ndarray],
    intrinsics: np.ndarray,
    found: FoundCameras | None,
) -> str:
    digest = hashlib.sha256(intrinsics.tobytes())
    if found is not None:
        digest.update(json.dumps(found.rig.to_dict(), allow_nan=False).encode())
    for name, array in arrays.items():
        digest.update(f"{name} {array.shape}".encode() + array.tobytes())
    for image, _ in pairing.pairs:
        digest.update(inspection.digests[image])
    return digest.hexdigest()
