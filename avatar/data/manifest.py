"""The prepared subject on disk: a folder with `manifest.json` and `tracks.safetensors`.

The manifest refers to the images of the tracked folder and copies none of them; masks that were derived lie in the
prepared folder. `MANIFEST_VERSION` grows with every change of meaning; other versions are prepared again.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from avatar.data.camera_rig import CameraRig, parse_rig
from avatar.data.json_values import parse_object, parse_positions
from avatar.data.read_image import EVERY_LABEL
from avatar.data.refinement_history import Refinement
from avatar.errors import UserError
from avatar.files.names import safe_name
from avatar.files.read import MissingFile, read_json

MANIFEST_VERSION = 9
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
    manifest = parse_object(raw, Manifest, rig=None)
    count = len(manifest.frames)
    parse_positions(raw["train"], "train", count)
    if manifest.test:  # a single frame is not divided
        parse_positions(raw["test"], "test", count)
    if not 1 <= manifest.width < 2**16 or not 1 <= manifest.height < 2**16:
        raise ValueError(f"an image size of {manifest.width}x{manifest.height} is impossible")
    if manifest.fps <= 0 or min(manifest.intrinsics[:2]) <= 0:
        raise ValueError("fps and focal lengths must be positive")
    for masks in (manifest.head_masks, manifest.mouth_masks):
        if masks not in ("source", "derived", "none"):
            raise ValueError(f"head_masks or mouth_masks is {masks!r}")
    for kind, label in manifest.labels.items():
        if kind not in MASKS or not EVERY_LABEL <= label < 255:
            raise ValueError(f"the label of {kind} is {label}")
    if set(manifest.train) & set(manifest.test):
        raise ValueError("a frame is in both train and test")
    for one in manifest.frames:
        for path in (one.image, one.alpha, one.head_mask, one.mouth_mask):
            _check_relative(path)
    rig = None if raw["rig"] is None else parse_rig(raw["rig"], count)
    return replace(manifest, name=safe_name(manifest.name), rig=rig)


def _check_relative(path: str | None) -> None:
    """Frame files must stay inside the folder that the manifest names."""
    if path is None:
        return
    escapes = any(p.is_absolute() or p.drive or ".." in p.parts for p in (PurePosixPath(path), PureWindowsPath(path)))
    os.fsencode(path)  # half a surrogate pair is no file's name; UnicodeEncodeError is a ValueError
    if not path or escapes or "\0" in path:
        raise ValueError(f"the path {path!r} leaves the subject's folder")
