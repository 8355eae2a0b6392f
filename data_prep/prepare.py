"""Tracked folder -> prepared subject: check, find the offset, pair, and write manifest and tracks. Cached by its inputs."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from avatar.data.images import read_bytes
from avatar.data.manifest import MANIFEST_VERSION, FrameRecord, Manifest
from avatar.data.source import Source
from avatar.data.split import DEFAULT_SIZES, SplitSizes
from avatar.errors import UserError, refuse
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from data_prep.face_parsing import HEAD, MOUTH, mask_of
from data_prep.formats import open_tracked_folder
from data_prep.frame_files import FrameFiles
from data_prep.frame_offset import detect_offset
from data_prep.inspect_images import Inspection, composited_background, inspect_images
from data_prep.overlap import confirm_pairing
from data_prep.pairing import Pairing, describe_reasons, pair_frames, refuse_if_many
from data_prep.projection import filled_lips, project_head, region_faces
from data_prep.tracked_folder import TrackedFolder, divide
from data_prep.tracking import Tracking, fit_coefficients
from data_prep.write_prepared import is_current, write_prepared

DEFAULT_FPS = 25.0  # of FlashAvatar's protocol, where a layout does not record it
MAX_FPS = 1000.0
HEAD_FOLDER, MOUTH_FOLDER = "head", "mouth"


def prepare(
    source: Source,
    head: HeadAssets,
    *,
    out: Path | str | None = None,
    split: SplitSizes | None = None,
    say: Callable[[str], object] = print,
) -> Path:
    """Prepare a tracked folder and return the prepared subject's folder; nothing is done when it is up to date.

    `head` is the head model that `source.head` names; `out` defaults to a folder in the cache (see `cache_folder`). `say`
    receives one sentence per finding. Raises UserError with the file or frame and what to do when the folder cannot be
    used.
    """
    folder, split = Path(source.folder).resolve(), split or DEFAULT_SIZES
    if source.fps is not None and not (math.isfinite(source.fps) and 0 < source.fps <= MAX_FPS):
        raise UserError(f"--fps must be above 0 and at most {MAX_FPS:g}, not {source.fps:g}")
    if not 0 <= source.max_left_out <= 1:
        raise UserError(f"--max-left-out must be from 0 to 1, not {source.max_left_out:g}")
    tracking = None if source.tracking is None else Path(source.tracking).resolve()
    tracked = open_tracked_folder(folder, tracking, source.format)
    files = tracked.files
    options = {
        "offset": source.frame_offset,
        "format": tracked.format,
        "split": list(split),
        "fps": source.fps,
        "max_left_out": source.max_left_out,
        "ignore_misfit": source.ignore_misfit,
        "head": head.fingerprint,
    }
    input_hash = _input_hash(files, options)
    target = Path(out).resolve() if out is not None else _default_location(files, options)
    if is_current(target, input_hash, is_chosen=out is not None):
        say(f"using the prepared subject {target}")
        return target

    say(f"format: {tracked.format}")
    inspection = inspect_images(files)
    refuse_if_many(inspection.bad, len(files.images), "images", source.max_left_out)
    tracks = tracked.read(head, (inspection.width, inspection.height), refuse)
    refuse_if_many(tracks.bad, len(files.tracking), "tracking files", source.max_left_out)
    tracks = fit_coefficients(tracks, head)
    first = next(iter(tracks.frames.values()))
    if first.size != (inspection.width, inspection.height):
        raise UserError(
            f"the tracking was made on {first.size[0]}x{first.size[1]} images, but those in "
            f"{next(iter(files.images.values())).parent} are {inspection.width}x{inspection.height}; resize the images "
            "or track them again"
        )
    model = HeadModel(head, torch.from_numpy(first.shape))
    offset, evidence = _pair(tracked, model, tracks, inspection, source)
    say(evidence)
    pairing = pair_frames(
        files, inspection, tracks, offset, model.neutral_vertices().mean(0).numpy(), source.max_left_out
    )
    has_lips = len(region_faces(model, "lips")) > 0
    frames_split, split_notes = divide(tracked.division, [number for _, number in pairing.pairs], split)
    notes = [*tracked.notes, *tracks.notes, *pairing.notes, *_assumptions(files, inspection, has_lips), *split_notes]
    for note in notes:
        say(f"note: {note}")
    if pairing.left_out:
        total = len(pairing.pairs) + len(pairing.left_out)
        say(f"warning: left out {len(pairing.left_out)} of {total} frames: {describe_reasons(pairing.left_out)}")
    arrays = _stack_tracks(tracks, pairing)
    names = files.frame_names()
    head_kind = "source" if files.head_masks else "derived" if files.parsing else "none"
    mouth_kind = "source" if files.mouth_masks else "derived" if files.parsing or has_lips else "none"
    manifest = Manifest(
        name=folder.name,
        format=tracked.format,
        source=str(folder),
        tracking=str(next(iter(files.tracking.values())).parent),
        width=inspection.width,
        height=inspection.height,
        fps=float(source.fps or tracked.fps or DEFAULT_FPS),
        intrinsics=tuple(first.intrinsics.tolist()),
        frame_offset=offset,
        offset_evidence=evidence,
        frames=_records(files, names, pairing, head_kind, mouth_kind),
        train=frames_split.train,
        test=frames_split.test,
        left_out={names[n]: reason for n, reason in pairing.left_out.items()},
        notes=tuple(notes),
        head_masks=head_kind,
        mouth_masks=mouth_kind,
        head_path=str(Path(source.head).resolve()),
        head_fingerprint=head.fingerprint,
        input_hash=input_hash,
        data_hash=_data_hash(inspection, pairing, arrays, first.intrinsics),
    )
    write_prepared(
        target, manifest, arrays, lambda building: _write_masks(building, manifest, files, model, tracks, pairing)
    )
    say(f"prepared {len(manifest.frames)} frames ({len(manifest.train)} train, {len(manifest.test)} test) in {target}")
    return target


def cache_folder() -> Path:
    """Where prepared subjects are kept: $AVATAR_CACHE, else ~/.cache/avatar."""
    given = os.environ.get("AVATAR_CACHE")
    return Path(given).expanduser() if given else Path.home() / ".cache" / "avatar"


def _default_location(files: FrameFiles, options: dict[str, object]) -> Path:
    tracking = next(iter(files.tracking.values())).parent
    key = hashlib.sha256(json.dumps([str(files.folder), str(tracking), options]).encode()).hexdigest()[:12]
    return cache_folder() / "subjects" / f"{files.folder.name}-{key}"


def _input_hash(files: FrameFiles, options: dict[str, object]) -> str:
    digest = hashlib.sha256(json.dumps([MANIFEST_VERSION, str(files.folder), options]).encode())
    for kind, found in files.of_kind().items():
        for number, path in found.items():
            digest.update(f"{kind} {number} {path} {_stamp(path)}\n".encode(errors="surrogateescape"))
    for path in files.listings:
        digest.update(f"{path} {_stamp(path)}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _stamp(path: Path) -> str:
    """Size and time, by which a change is noticed; a file that is named but not there is noticed when it comes."""
    try:
        status = path.stat()
    except OSError:
        return "missing"
    return f"{status.st_size} {status.st_mtime_ns}"


def _pair(
    tracked: TrackedFolder, model: HeadModel, tracks: Tracking, inspection: Inspection, source: Source
) -> tuple[int, str]:
    """The offset (image number - tracking number) and a sentence on how it was found."""
    images, heads, mouths = (
        {n: path for n, path in found.items() if n not in inspection.bad}
        for found in (tracked.files.images, tracked.files.head_masks or tracked.files.alphas, tracked.files.mouth_masks)
    )
    given = source.frame_offset
    first = next(iter(tracks.frames.values()))
    if tracked.is_paired:
        tracked.refuse_offset(given)
        witness = (
            "--frame-offset 0: not confirmed"
            if given is not None
            else confirm_pairing(model, tracks.frames, first.intrinsics, heads)
        )
        return 0, f"images and tracking are paired by {tracked.files.listings[0].name}: {witness}"
    if given is not None:
        return given, f"image offset {given}, given with --frame-offset"
    estimate = detect_offset(model, tracks.frames, first.intrinsics, images, heads, mouths)
    return estimate.offset, estimate.sentence()


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
    colour = composited_background(files, inspection.bad) if files.alphas else None
    if colour is not None:
        notes.append(
            f"the images seem to be composited on {colour} already: compositing them again with their matte squares it at "
            "the edges"
        )
    return notes


def _stack_tracks(tracks: Tracking, pairing: Pairing) -> dict[str, np.ndarray]:
    used = [tracks.frames[number] for _, number in pairing.pairs]
    moving = ("expression", "jaw", "eyes", "eyelids", "neck", "R", "t")
    arrays = {name: np.stack([getattr(track, name) for track in used]) for name in moving}
    arrays["shape"] = used[0].shape
    return {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in sorted(arrays.items())}


def _records(
    files: FrameFiles, names: dict[int, str], pairing: Pairing, head_kind: str, mouth_kind: str
) -> tuple[FrameRecord, ...]:
    def inside(paths: dict[int, Path], number: int) -> str | None:
        return paths[number].relative_to(files.folder).as_posix() if paths else None

    def mask(kind: str, folder: str, paths: dict[int, Path], number: int) -> str | None:
        return f"{folder}/{names[number]}.png" if kind == "derived" else inside(paths, number)

    return tuple(
        FrameRecord(
            name=names[image],
            image=files.images[image].relative_to(files.folder).as_posix(),
            tracking=number,
            alpha=inside(files.alphas, image),
            head_mask=mask(head_kind, HEAD_FOLDER, files.head_masks, image),
            mouth_mask=mask(mouth_kind, MOUTH_FOLDER, files.mouth_masks, image),
        )
        for image, number in pairing.pairs
    )


def _write_masks(
    building: Path, manifest: Manifest, files: FrameFiles, model: HeadModel, tracks: Tracking, pairing: Pairing
) -> None:
    """The masks that the source does not have: from its face parsing, else the projected lips."""
    for folder, kind in ((HEAD_FOLDER, manifest.head_masks), (MOUTH_FOLDER, manifest.mouth_masks)):
        if kind == "derived":
            (building / folder).mkdir()
    lips = region_faces(model, "lips")
    size = manifest.width, manifest.height
    for record, (image, number) in zip(manifest.frames, pairing.pairs, strict=True):
        classes = None
        if image in files.parsing:
            classes = files.decode_parsing(read_bytes(files.parsing[image]), files.parsing[image])
        if manifest.head_masks == "derived" and classes is not None:
            _write_mask(building / str(record.head_mask), mask_of(classes, HEAD))
        if manifest.mouth_masks == "derived":
            if classes is None:
                screen = project_head(model, tracks.frames[number], np.array(manifest.intrinsics), *size)
                _write_mask(building / str(record.mouth_mask), filled_lips(screen, lips, *size) * 255)
            else:
                _write_mask(building / str(record.mouth_mask), mask_of(classes, MOUTH))


def _write_mask(path: Path, mask: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".png", mask)[1].tobytes())  # cv2.imwrite does not notice a full disk


def _data_hash(inspection: Inspection, pairing: Pairing, arrays: dict[str, np.ndarray], intrinsics: np.ndarray) -> str:
    digest = hashlib.sha256(intrinsics.tobytes())
    for name, array in arrays.items():
        digest.update(f"{name} {array.shape}".encode() + array.tobytes())
    for image, _ in pairing.pairs:
        digest.update(inspection.digests[image])
    return digest.hexdigest()
