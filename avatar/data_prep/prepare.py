"""Tracked folder -> prepared subject: check, find the offset, pair, and write manifest and tracks. Cached by its inputs."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.numpy import save_file

from avatar.data.manifest import (
    MANIFEST_FILE,
    MANIFEST_VERSION,
    TRACKS_FILE,
    FrameRecord,
    Manifest,
    read_manifest,
)
from avatar.data.split import DEFAULT_SIZES, SplitSizes, split_frames
from avatar.data_prep.frame_files import FrameFiles, find_frame_files
from avatar.data_prep.frame_offset import detect_offset
from avatar.data_prep.inspect_images import Inspection, composited_background, inspect_images
from avatar.data_prep.metrical_tracker import FrameTrack, Tracking, neck_identity, read_tracking
from avatar.data_prep.pairing import Pairing, describe_reasons, pair_frames, refuse_if_many
from avatar.data_prep.projection import filled_lips, project_head, region_faces
from avatar.errors import UserError
from avatar.head.assets import IDENTITY_COEFFICIENTS, HeadAssets
from avatar.head.model import HeadModel

DEFAULT_FPS = 25.0  # of FlashAvatar's protocol; the layout does not record it
MOUTH_FOLDER = "mouth"


def prepare(
    folder: Path | str,
    head: HeadAssets,
    head_path: Path | str,
    *,
    tracking: Path | str | None = None,
    frame_offset: int | None = None,
    out: Path | str | None = None,
    split: SplitSizes | None = None,
    fps: float = DEFAULT_FPS,
    say: Callable[[str], object] = print,
) -> Path:
    """Prepare a tracked folder and return the prepared subject's folder; nothing is done when it is up to date.

    `out` defaults to a folder in the cache (see `cache_folder`). `say` receives one sentence per finding. Raises UserError
    with the file or frame and what to do when the folder cannot be used.
    """
    folder, split = Path(folder).resolve(), split or DEFAULT_SIZES
    files = find_frame_files(folder, None if tracking is None else Path(tracking).resolve())
    if not (np.isfinite(fps) and fps > 0):
        raise UserError(f"fps must be positive, not {fps}")
    options = {"offset": frame_offset, "split": list(split), "fps": fps, "head": head.fingerprint}
    input_hash = _input_hash(files, options)
    target = Path(out).resolve() if out is not None else _default_location(files, options)
    if _is_current(target, input_hash, is_chosen=out is not None):
        say(f"using the prepared subject {target}")
        return target

    inspection = inspect_images(files)
    refuse_if_many(inspection.bad, len(files.images), "images")
    tracks = read_tracking(files.tracking)
    refuse_if_many(tracks.bad, len(files.tracking), "tracking files")
    first = next(iter(tracks.frames.values()))
    if first.size != (inspection.width, inspection.height):
        raise UserError(
            f"the tracking was made on {first.size[0]}x{first.size[1]} images, but those in {folder / 'imgs'} are "
            f"{inspection.width}x{inspection.height}; resize the images or track them again"
        )
    notes = list(tracks.notes)
    coefficients = fitted_coefficients(tracks, head, notes)
    model = HeadModel(head, torch.from_numpy(coefficients["shape"]))
    if frame_offset is None:
        images, heads, mouths = (
            {n: path for n, path in found.items() if n not in inspection.bad}
            for found in (files.images, files.head_masks or files.alphas, files.mouth_masks)
        )
        estimate = detect_offset(model, tracks.frames, first.intrinsics, images, heads, mouths)
        offset, evidence = estimate.offset, estimate.sentence()
    else:
        offset, evidence = frame_offset, f"image offset {frame_offset}, given with --frame-offset"
    say(evidence)
    pairing = pair_frames(files, inspection, tracks, offset, model.neutral_vertices().mean(0).numpy())
    notes += pairing.notes + _assumptions(files, inspection, has_lips=len(region_faces(model, "lips")) > 0)
    for note in notes:
        say(f"note: {note}")
    if pairing.left_out:
        total = len(pairing.pairs) + len(pairing.left_out)
        say(f"warning: left out {len(pairing.left_out)} of {total} frames: {describe_reasons(pairing.left_out)}")
    frames_split = split_frames(len(pairing.pairs), split)
    arrays = _stack_tracks(tracks, pairing, coefficients)
    mouth_kind = "source" if files.mouth_masks else "derived" if len(region_faces(model, "lips")) else "none"
    manifest = Manifest(
        name=folder.name,
        source=str(folder),
        tracking=str(next(iter(files.tracking.values())).parent),
        width=inspection.width,
        height=inspection.height,
        fps=float(fps),
        intrinsics=tuple(first.intrinsics.tolist()),
        frame_offset=offset,
        offset_evidence=evidence,
        frames=_records(files, pairing, mouth_kind),
        train=frames_split.train,
        test=frames_split.test,
        left_out={files.images[n].stem: reason for n, reason in pairing.left_out.items()},
        notes=tuple(notes),
        mouth_masks=mouth_kind,
        head_path=str(Path(head_path).resolve()),
        head_fingerprint=head.fingerprint,
        input_hash=input_hash,
        data_hash=_data_hash(inspection, pairing, arrays, first.intrinsics),
    )
    _write(target, manifest, arrays, model, tracks, pairing)
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
            status = path.stat()
            digest.update(
                f"{kind} {number} {path} {status.st_size} {status.st_mtime_ns}\n".encode(errors="surrogateescape")
            )
    return digest.hexdigest()


def _is_current(target: Path, input_hash: str, is_chosen: bool) -> bool:
    """Whether `target` was prepared from these inputs. A chosen folder that is something else is never overwritten."""
    try:
        names = {path.name for path in target.iterdir()}
    except FileNotFoundError:
        return False
    except NotADirectoryError:
        names = {target.name} if target.exists() else set()
    if MANIFEST_FILE not in names:
        if is_chosen and names:
            raise UserError(f"{target} exists and is not a prepared subject; choose another --out")
        return False
    try:
        return read_manifest(target).input_hash == input_hash and (target / TRACKS_FILE).is_file()
    except UserError:
        return False


def fitted_coefficients(tracks: Tracking, head: HeadAssets, notes: list[str]) -> dict[str, np.ndarray]:
    """Identity [300] of the first frame and expressions [n, E] of all, fitted to the head model's number of directions."""
    expression = np.stack([track.expression for track in tracks.frames.values()])
    shape = next(iter(tracks.frames.values())).shape[None]
    return {
        "shape": _fitted(shape, IDENTITY_COEFFICIENTS, "identity", notes)[0],
        "expression": _fitted(expression, head.num_expressions, "expression", notes),
    }


def _fitted(values: np.ndarray, count: int, what: str, notes: list[str]) -> np.ndarray:
    have = values.shape[1]
    if values[:, count:].any():
        raise UserError(
            f"the tracking has {have} {what} coefficients but the head model has {count} {what} directions; give --head "
            "the model that the tracking was made with"
        )
    if have != count:
        notes.append(f"the tracking has {have} {what} coefficients, the head model {count}; the missing ones are zero")
    return np.pad(values[:, :count], ((0, 0), (0, max(0, count - have)))).astype(np.float32)


def _assumptions(files: FrameFiles, inspection: Inspection, has_lips: bool) -> list[str]:
    notes = []
    if not files.alphas:
        notes.append("there is no alpha/: the whole image is taken as foreground")
    if not files.head_masks:
        taken = "the foreground matte" if files.alphas else "the whole image"
        notes.append(f"there are no parsing/*_neckhead.png: {taken} is taken as the head")
    if not files.mouth_masks:
        made = "masks of the projected lips are made" if has_lips else "the head model has no lips, so no mouth weight"
        notes.append(f"there are no parsing/*_mouth.png: {made}")
    colour = composited_background(files, inspection.bad) if files.alphas else None
    if colour is not None:
        notes.append(
            f"the images seem to be composited on {colour} already: compositing them again with alpha/ squares the matte "
            "at the edges"
        )
    return notes


def _stack_tracks(tracks: Tracking, pairing: Pairing, coefficients: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    row = {number: i for i, number in enumerate(tracks.frames)}
    used: list[FrameTrack] = [tracks.frames[number] for _, number in pairing.pairs]
    arrays = {name: np.stack([getattr(t, name) for t in used]) for name in ("jaw", "eyes", "eyelids", "R", "t")}
    arrays["expression"] = coefficients["expression"][[row[number] for _, number in pairing.pairs]]
    arrays["neck"] = neck_identity(len(used))
    arrays["shape"] = coefficients["shape"]
    return {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in sorted(arrays.items())}


def _records(files: FrameFiles, pairing: Pairing, mouth_kind: str) -> tuple[FrameRecord, ...]:
    def inside(paths: dict[int, Path], number: int) -> str | None:
        return paths[number].relative_to(files.folder).as_posix() if paths else None

    return tuple(
        FrameRecord(
            name=files.images[image].stem,
            image=files.images[image].relative_to(files.folder).as_posix(),
            tracking=number,
            alpha=inside(files.alphas, image),
            head_mask=inside(files.head_masks, image),
            mouth_mask=f"{MOUTH_FOLDER}/{files.images[image].stem}.png"
            if mouth_kind == "derived"
            else inside(files.mouth_masks, image),
        )
        for image, number in pairing.pairs
    )


def _data_hash(inspection: Inspection, pairing: Pairing, arrays: dict[str, np.ndarray], intrinsics: np.ndarray) -> str:
    digest = hashlib.sha256(intrinsics.tobytes())
    for name, array in arrays.items():
        digest.update(f"{name} {array.shape}".encode() + array.tobytes())
    for image, _ in pairing.pairs:
        digest.update(inspection.digests[image])
    return digest.hexdigest()


def _write(
    target: Path,
    manifest: Manifest,
    arrays: dict[str, np.ndarray],
    model: HeadModel,
    tracks: Tracking,
    pairing: Pairing,
) -> None:
    """Write beside the target and rename, so that a prepared subject is either whole or not there."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        building = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise UserError(f"nothing can be written in {target.parent} ({error.strerror}); choose another place") from None
    try:
        save_file(arrays, building / TRACKS_FILE)
        if manifest.mouth_masks == "derived":
            (building / MOUTH_FOLDER).mkdir()
            lips = region_faces(model, "lips")
            size = manifest.width, manifest.height
            for record, (_, number) in zip(manifest.frames, pairing.pairs, strict=True):
                screen = project_head(model, tracks.frames[number], np.array(manifest.intrinsics), *size)
                cv2.imwrite(str(building / str(record.mouth_mask)), filled_lips(screen, lips, *size) * 255)
        (building / MANIFEST_FILE).write_text(manifest.to_json(), encoding="utf-8")
        building.chmod(0o755)
        _replace(target, building, manifest.input_hash)
    except OSError as error:
        raise UserError(f"the prepared subject cannot be written to {target} ({error.strerror})") from error
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _replace(target: Path, building: Path, input_hash: str) -> None:
    """Rename `building` to `target`, moving away what is there; another process may be doing the same."""
    for attempt in range(100):
        try:
            building.rename(target)
            return
        except OSError:
            if attempt == 99:
                raise
            if not target.exists():
                continue  # moved away just now by another process
        if _is_current(target, input_hash, is_chosen=False):
            return
        stale = Path(tempfile.mkdtemp(prefix=f".{target.name}-old-", dir=target.parent))
        with contextlib.suppress(FileNotFoundError):
            target.rename(stale / "old")
        shutil.rmtree(stale)
