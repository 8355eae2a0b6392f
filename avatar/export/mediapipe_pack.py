"""MediaPipe's face landmarker for an exported page, as one script beside it: browsers let a page from a file run what lies
beside it, and read nothing.

    /* whose it is, and its licence */
    avatarLandmarker({"version": ..., "files": {name: base64 of gzip}});

The page takes the files by their SHA-256 (avatar/web/landmarker.js), and calls nothing of them before.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import tarfile
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, distribution

from avatar.errors import UserError
from avatar.files.read import read_bytes
from avatar.files.third_party import FACE_LANDMARKER, TASKS_VISION, TASKS_VISION_VERSION, require

PACK = "face-landmarker.js"
MEMBERS = ("vision_bundle.mjs", "wasm/vision_wasm_internal.js", "wasm/vision_wasm_internal.wasm")
NOTICE = (
    f"MediaPipe Tasks Vision {TASKS_VISION_VERSION} and face_landmarker.task, (c) The MediaPipe Authors, Google LLC; "
    "Apache License 2.0"
)


def make_pack() -> bytes:
    """The script, of the publisher's files in the cache or in $AVATAR_MODELS. Raises UserError where one is missing."""
    package, model = require(TASKS_VISION), require(FACE_LANDMARKER)
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(read_bytes(package, TASKS_VISION.max_bytes)), mode="r:gz") as archive:
            for name in MEMBERS:
                member = archive.extractfile(f"package/{name}")
                assert member is not None  # its SHA-256 has been checked
                files[name.rpartition("/")[2]] = member.read()
        files[FACE_LANDMARKER.name] = read_bytes(model, FACE_LANDMARKER.max_bytes)
    except OSError as error:
        raise UserError(f"{package} or {model} cannot be read ({error.strerror or error})") from None
    return encode_pack(files)


def encode_pack(files: Mapping[str, bytes], version: str = TASKS_VISION_VERSION) -> bytes:
    packed = {name: base64.b64encode(gzip.compress(data, 9, mtime=0)).decode() for name, data in files.items()}
    content = json.dumps({"version": version, "files": packed}, separators=(",", ":"), allow_nan=False)
    return f"/* {NOTICE}\n\n{apache_licence()}*/\navatarLandmarker({content});\n".encode()


def apache_licence() -> str:
    """Its text, which is to go along: this program's own, installed with it; else where it is to be had."""
    try:
        text = distribution("hyperavatar").read_text("licenses/LICENSE")
    except PackageNotFoundError:
        text = None
    return text or "https://www.apache.org/licenses/LICENSE-2.0\n"
