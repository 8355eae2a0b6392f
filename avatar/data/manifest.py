"""The prepared subject on disk: a folder with `manifest.json` and `tracks.safetensors`.

The manifest refers to the images of the tracked folder and copies none of them; masks that were derived lie in the
prepared folder. `MANIFEST_VERSION` grows with every change of meaning; other versions are prepared again.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from avatar.data.camera_rig import CameraRig, parse_rig
from avatar.data.images import EVERY_LABEL
from avatar.data.json_values import parse_intrinsics, parse_number, parse_positions
from avatar.data.refinement import Refinement
from avatar.errors import UserError
from avatar.files.names import safe_name
from avatar.files.read import MissingFile, read_json

MANIFEST_VERSION = 7
MANIFEST_FILE, TRACKS_FILE = "manifest.json", "tracks.safetensors"
GIVEN = "given."  # before the names of the tracks as they were before their refinement
MASKS = ("alpha", "head", "mouth")  # keys of `Manifest.labels`
_MAX_BYTES = 2**28


@dataclass(frozen=True)
class FrameRecord:
    """One usable frame: its files, relative to the source folder (or to the prepared one, see `Manifest`)."""

    name: str  # stem of the image
    image: str
    tracking: int  # number of the tracking frame; pictures of one time share it
    alpha: str | None  # the image itself: its transparency is the matte
    head_mask: str | None
    mouth_mask: str | None


@dataclass(frozen=True)
class Manifest:
    name: str
    format: str  # whose layout the tracked folder has
    source: str  # absolute path of the tracked folder
    tracking: str  # absolute path of the folder of tracking files
    width: int  # pixels
    height: int
    fps: float
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels
    frame_offset: int  # image number - tracking number
    offset_evidence: str  # how the offset was found, one sentence
    frames: tuple[FrameRecord, ...]
    train: tuple[int, ...]  # indices into frames
    test: tuple[int, ...]  # empty where there is a single frame
    left_out: dict[str, str]  # image name -> reason
    notes: tuple[str, ...]  # what was assumed or found, one sentence each
    head_masks: str  # "source", "derived" (in the prepared folder) or "none"
    mouth_masks: str  # the same
    head_path: str  # absolute path of the head model
    head_fingerprint: str
    input_hash: str  # of names, sizes and times of the inputs, and the options: decides whether to prepare again
    data_hash: str  # of the contents: the same data gives the same hash on every machine
    refinement: Refinement | None = None  # of the tracking; None where it is the tracker's own
    rig: CameraRig | None = None  # of several cameras; None: one. Size and intrinsics above are of its first camera
    labels: dict[str, int] = field(default_factory=dict)  # of masks that are label images: what is read as 255

    def number(self, index: int) -> int:
        """What a folder of refined tracking numbers a frame by: its image's number; with several cameras, as it was first
        refined, its index."""
        if self.rig is None:
            return self.frames[index].tracking + self.frame_offset
        return index if self.refinement is None else int(self.frames[index].name)

    def to_json(self) -> str:
        return json.dumps({"version": MANIFEST_VERSION, **asdict(self)}, indent=1, allow_nan=False)


def read_manifest(prepared: Path) -> Manifest:
    """Read and check `prepared/manifest.json`. Raises UserError with the file and what is wrong with it."""
    file = Path(prepared) / MANIFEST_FILE
    try:
        raw = read_json(file, _MAX_BYTES)
    except MissingFile:
        raise UserError(f"{prepared} is not a prepared subject: it has no {MANIFEST_FILE}") from None
    except UserError as error:
        raise UserError(f"{error}; prepare the subject again") from None
    if not isinstance(raw, dict) or raw.get("version") != MANIFEST_VERSION:
        version = raw.get("version") if isinstance(raw, dict) else None
        raise UserError(
            f"{file} has manifest version {version!r}, and this program reads {MANIFEST_VERSION}; prepare it again"
        )
    try:
        return _parse(raw)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise UserError(f"{file} is damaged ({reason}); prepare the subject again") from None


def _parse(raw: dict[str, Any]) -> Manifest:
    frames = tuple(_parse_frame(entry) for entry in _of(raw, "frames", list))
    count = len(frames)
    manifest = Manifest(
        name=safe_name(_of(raw, "name", str)),
        format=_of(raw, "format", str),
        source=_of(raw, "source", str),
        tracking=_of(raw, "tracking", str),
        width=_of(raw, "width", int),
        height=_of(raw, "height", int),
        fps=parse_number(raw["fps"], "fps"),
        intrinsics=parse_intrinsics(raw["intrinsics"]),
        frame_offset=_of(raw, "frame_offset", int),
        offset_evidence=_of(raw, "offset_evidence", str),
        frames=frames,
        train=parse_positions(raw["train"], "train", count),
        test=parse_positions(raw["test"], "test", count) if raw["test"] != [] else (),  # a single frame is not divided
        left_out={str(k): str(v) for k, v in _of(raw, "left_out", dict).items()},
        notes=tuple(str(note) for note in _of(raw, "notes", list)),
        head_masks=_of(raw, "head_masks", str),
        mouth_masks=_of(raw, "mouth_masks", str),
        labels=_labels(_of(raw, "labels", dict)),
        head_path=_of(raw, "head_path", str),
        head_fingerprint=_of(raw, "head_fingerprint", str),
        input_hash=_of(raw, "input_hash", str),
        data_hash=_of(raw, "data_hash", str),
        refinement=None if raw["refinement"] is None else _refinement(raw["refinement"]),
        rig=None if raw["rig"] is None else parse_rig(raw["rig"], count),
    )
    if not 1 <= manifest.width < 2**16 or not 1 <= manifest.height < 2**16:
        raise ValueError(f"an image size of {manifest.width}x{manifest.height} is impossible")
    if manifest.fps <= 0 or min(manifest.intrinsics[:2]) <= 0:
        raise ValueError("fps and focal lengths must be positive")
    for masks in (manifest.head_masks, manifest.mouth_masks):
        if masks not in ("source", "derived", "none"):
            raise ValueError(f"head_masks or mouth_masks is {masks!r}")
    if set(manifest.train) & set(manifest.test):
        raise ValueError("a frame is in both train and test")
    return manifest


def _labels(raw: dict[str, Any]) -> dict[str, int]:
    for kind in raw:
        if kind not in MASKS or not EVERY_LABEL <= _of(raw, kind, int) < 255:
            raise ValueError(f"the label of {kind} is {raw[kind]}")
    return raw


def _refinement(raw: Any) -> Refinement:
    try:
        return Refinement.from_dict(raw)
    except UserError as error:
        raise ValueError(f"refinement: {error}") from None


def _parse_frame(entry: Any) -> FrameRecord:
    if not isinstance(entry, dict):
        raise TypeError("an entry of frames is not an object")
    return FrameRecord(
        name=_of(entry, "name", str),
        image=_relative(_of(entry, "image", str)),
        tracking=_of(entry, "tracking", int),
        alpha=_relative_or_none(entry["alpha"]),
        head_mask=_relative_or_none(entry["head_mask"]),
        mouth_mask=_relative_or_none(entry["mouth_mask"]),
    )


def _of(raw: dict[str, Any], key: str, kind: type) -> Any:
    value = raw[key]
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise TypeError(f"{key} is a {type(value).__name__}, not a {kind.__name__}")
    return value


def _relative_or_none(value: Any) -> str | None:
    if value is None:
        return None
    if not isinstance(value, str):
        raise TypeError(f"a path is a {type(value).__name__}, not a str")
    return _relative(value)


def _relative(value: str) -> str:
    """Frame files must stay inside the folder that the manifest names."""
    escapes = any(p.is_absolute() or p.drive or ".." in p.parts for p in (PurePosixPath(value), PureWindowsPath(value)))
    os.fsencode(value)  # half a surrogate pair is no file's name; UnicodeEncodeError is a ValueError
    if not value or escapes or "\0" in value:
        raise ValueError(f"the path {value!r} leaves the subject's folder")
    return value
