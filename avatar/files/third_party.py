"""Files of others that the program can use and does not contain: what they are for, where they are looked for and had.

Each is looked for in the folder $AVATAR_MODELS, in the folders directly inside that, and in the cache (`models` in
$AVATAR_CACHE, else in ~/.cache/avatar). A file counts only with the published SHA-256.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import NamedTuple

from avatar.errors import UserError

FOLDER_VARIABLE = "AVATAR_MODELS"


class ThirdPartyFile(NamedTuple):
    name: str  # in our folders
    url: str  # of the publisher
    sha256: str  # all 64 hex digits, or as many first ones as the publisher gives (torchvision: 8, in the file name)
    megabytes: float
    licence: str
    purpose: str


_MEDIAPIPE = "https://storage.googleapis.com/mediapipe-models/"
FACE_LANDMARKER = ThirdPartyFile(
    "face_landmarker.task",
    _MEDIAPIPE + "face_landmarker/face_landmarker/float16/1/face_landmarker.task",
    "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff",
    3.8,
    "Apache-2.0, Google",
    "face landmarks (track)",
)
SELFIE_SEGMENTATION = ThirdPartyFile(
    "selfie_segmentation.tflite",
    "https://cdn.jsdelivr.net/npm/@mediapipe/selfie_segmentation@0.1.1675465747/selfie_segmentation.tflite",
    "9ee168ec7c8f2a16c56fe8e1cfbc514974cbbb7e434051b455635f1bd1462f5c",
    0.2,
    "Apache-2.0, Google",
    "mattes (track)",
)
SELFIE_MULTICLASS = ThirdPartyFile(
    "selfie_multiclass_256x256.tflite",
    _MEDIAPIPE + "image_segmenter/selfie_multiclass_256x256/float32/1/selfie_multiclass_256x256.tflite",
    "c6748b1253a99067ef71f7e26ca71096cd449baefa8f101900ea23016507e0e0",
    16.4,
    "Apache-2.0, Google",
    "better mattes and head masks (track), optional",
)
TRACKING_FILES = (FACE_LANDMARKER, SELFIE_SEGMENTATION, SELFIE_MULTICLASS)


def models_folder() -> Path:
    """Where downloads go: `models` in the cache."""
    cache = os.environ.get("AVATAR_CACHE")
    return (Path(cache).expanduser() if cache else Path.home() / ".cache" / "avatar") / "models"


def search_folders() -> list[Path]:
    """The folders that files are looked for in, in this order."""
    named = os.environ.get(FOLDER_VARIABLE)
    folders = [models_folder()]
    if named:
        place = Path(named).expanduser()
        inside = sorted(path for path in place.iterdir() if path.is_dir()) if place.is_dir() else []
        folders = [place, *inside, *folders]
    return folders


def find(file: ThirdPartyFile) -> Path | None:
    """The first place where a file of that name lies, whatever is in it."""
    return next((path for folder in search_folders() if (path := folder / file.name).is_file()), None)


def require(file: ThirdPartyFile) -> Path:
    """Where the published file lies. Raises UserError, with what to do, where it is missing or another file."""
    path = find(file)
    if path is None:
        raise UserError(
            f"{file.name} ({file.purpose}; {file.licence}) is missing: run avatar models --download, or fetch "
            f"{file.url} and put it into {models_folder()} or the folder that ${FOLDER_VARIABLE} names"
        )
    check_sha256(file, sha256_of(path), str(path))
    return path


def sha256_of(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        with path.open("rb") as opened:
            while chunk := opened.read(1 << 20):
                digest.update(chunk)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from None
    return digest.hexdigest()


def check_sha256(file: ThirdPartyFile, digest: str, source: str) -> None:
    """Raises UserError where the SHA-256 is another than the published one; `source` is for the message."""
    if not digest.startswith(file.sha256):
        raise UserError(
            f"{source} is not the published file or is damaged: its SHA-256 is {digest[: len(file.sha256)]}, not "
            f"{file.sha256}; fetch {file.url} again"
        )
