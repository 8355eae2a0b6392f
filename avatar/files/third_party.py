"""Files of others that the program can use and does not contain: what they are for, where they are looked for and had.

Each is looked for in the folder $AVATAR_MODELS, in the folders directly inside that, and in the cache (`models` in
$AVATAR_CACHE, else in ~/.cache/avatar). A file counts only with the published SHA-256.
"""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path
from typing import NamedTuple

from avatar.errors import UserError
from avatar.files.download import DownloadFailed, downloaded
from avatar.files.environment import cache_folder, named_path
from avatar.files.read import is_there, open_file

FOLDER_VARIABLE, HEAD_VARIABLE = "AVATAR_MODELS", "AVATAR_HEAD"
FETCHED_LPIPS = ("squeeze",)  # what training and evaluation use; vgg is 528 MB and alex 233


class ThirdPartyFile(NamedTuple):
    name: str  # in our folders
    url: str  # of the publisher
    sha256: str  # all 64 hex digits, or as many first ones as the publisher gives (torchvision: 8, in the file name)
    megabytes: float = 0.0
    licence: str = ""
    purpose: str = ""
    is_optional: bool = False

    @property
    def max_bytes(self) -> int:
        """No file of this name has more: publishers round, to megabytes of either kind."""
        return int(1.25 * self.megabytes * 2**20) + 2**20


_MEDIAPIPE = "https://storage.googleapis.com/mediapipe-models/"
FACE_LANDMARKER = ThirdPartyFile(
    "face_landmarker.task",
    _MEDIAPIPE + "face_landmarker/face_landmarker/float16/1/face_landmarker.task",
    "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff",
    3.8,
    "Apache-2.0, Google",
    "face landmarks (track, record, view --webcam, export --webcam)",
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
    "better mattes (track)",
    is_optional=True,
)
MODNET = ThirdPartyFile(
    "modnet.onnx",
    "https://huggingface.co/Xenova/modnet/resolve/fa2fa546052fba4c08921230a26cc69a333fca12/onnx/model.onnx",
    "07c308cf0fc7e6e8b2065a12ed7fc07e1de8febb7dc7839d7b7f15dd66584df9",
    25.9,
    "Apache-2.0, Z. Ke",
    "soft mattes (track)",
    is_optional=True,
)
ROBUST_VIDEO_MATTING = ThirdPartyFile(
    "rvm_mobilenetv3_fp32.onnx",
    "https://github.com/PeterL1n/RobustVideoMatting/releases/download/v1.0.0/rvm_mobilenetv3_fp32.onnx",
    "88d4531297118f595bf2fd60f6f566aec2e559393802d1f436c380f0cbbd2828",
    15.0,
    "GPL-3.0, ByteDance",
    "soft and steady mattes (track)",
    is_optional=True,
)
MATTING_FILES = (ROBUST_VIDEO_MATTING, MODNET)
"""The best first; never downloaded: who wants one puts it there."""
TASKS_VISION_VERSION = "0.10.21"
TASKS_VISION = ThirdPartyFile(
    f"mediapipe-tasks-vision-{TASKS_VISION_VERSION}.tgz",
    f"https://registry.npmjs.org/@mediapipe/tasks-vision/-/tasks-vision-{TASKS_VISION_VERSION}.tgz",
    "343736570f433c0100ffc360dbe70f09cc502a5fc573f5cd95954692edc9cfde",
    6.2,
    "Apache-2.0, Google",
    "pages that a camera drives (export --webcam)",
    is_optional=True,
)
"""For browsers. Later versions (1.1.0) report their use to their maker."""
PAGE_FILES = (TASKS_VISION,)
TRACKING_FILES = (FACE_LANDMARKER, SELFIE_SEGMENTATION, SELFIE_MULTICLASS)

_TORCHVISION = "https://download.pytorch.org/models/"
_HEADS = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/"


def _lpips(net: str, backbone: str, megabytes: float, heads_sha256: str) -> tuple[ThirdPartyFile, ThirdPartyFile]:
    """Backbone and linear heads. torchvision publishes the first eight digits of the hash, in the file's name."""
    digits = backbone.rpartition("-")[2].removesuffix(".pth")
    return (
        ThirdPartyFile(
            backbone, _TORCHVISION + backbone, digits, megabytes, "BSD-3-Clause, torchvision", f"LPIPS {net}"
        ),
        ThirdPartyFile(
            f"lin_v0.1_{net}.pth", f"{_HEADS}{net}.pth", heads_sha256, 0.01, "BSD-2-Clause, R. Zhang", f"LPIPS {net}"
        ),
    )


LPIPS_FILES = {
    "vgg": _lpips("vgg", "vgg16-397923af.pth", 528, "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"),
    "alex": _lpips(
        "alex", "alexnet-owt-7be5be79.pth", 233, "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"
    ),
    "squeeze": _lpips(
        "squeeze", "squeezenet1_1-b8a52dc0.pth", 4.7, "4a5350f23600cb79923ce65bb07cbf57dca461329894153e05a1346bd531cf76"
    ),
}
"""Weights of the networks of LPIPS."""


def models_folder() -> Path:
    """Where downloads go: `models` in the cache."""
    return cache_folder() / "models"


def lpips_folder() -> Path:
    """Where weights of LPIPS are looked for when the caller names no place: $AVATAR_LPIPS, else `lpips` in the cache."""
    return named_path("AVATAR_LPIPS") or cache_folder() / "lpips"


def lpips_place(net: str) -> Path:
    """The first folder that holds weights of this network: $AVATAR_LPIPS or the cache's, then those of $AVATAR_MODELS."""
    own = lpips_folder()
    return next((folder for folder in (own, *search_folders()) if has_lpips(folder, net)), own)


def has_lpips(folder: Path, net: str) -> bool:
    names = {converted_lpips(net)}, {file.name for file in LPIPS_FILES[net]}
    return any(all((folder / name).is_file() for name in wanted) for wanted in names)


def converted_lpips(net: str) -> str:
    """The name of a file with all weights of a network."""
    return f"lpips_{net}.safetensors"


def search_folders() -> list[Path]:
    """The folders that files are looked for in, in this order."""
    place = named_path(FOLDER_VARIABLE)
    folders = [models_folder()]
    if place is not None:
        inside = sorted(path for path in place.iterdir() if path.is_dir()) if place.is_dir() else []
        folders = [place, *inside, *folders]
    return folders


def find(file: ThirdPartyFile) -> Path | None:
    """The first place where the published file lies; where none does, the first where anything has its name."""
    places = [path for folder in search_folders() if is_there(path := folder / file.name)]
    return next((path for path in places if is_published(file, path)), next(iter(places), None))


def require(file: ThirdPartyFile) -> Path:
    """Where the published file lies. Raises UserError, with what to do, where it is missing or another file."""
    path = find(file)
    if path is None:
        raise UserError(
            f"{file.name} ({file.purpose}; {file.licence}) is missing: run avatar models --download, or fetch "
            f"{file.url} and put it into {models_folder()} or the folder that ${FOLDER_VARIABLE} names"
        )
    check_sha256(file, sha256_of(path, file.max_bytes), str(path))
    return path


def is_published(file: ThirdPartyFile, path: Path) -> bool:
    try:
        check_sha256(file, sha256_of(path, file.max_bytes), str(path))
    except UserError:
        return False
    return True


def download(file: ThirdPartyFile) -> Path:
    """Fetch a file from its publisher into `models_folder`, whole and checked or not at all; what has its name there is
    replaced. Raises UserError.
    """
    target = models_folder() / file.name
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix="download-") as name:
            fetch(file, Path(name) / file.name, target)
            (Path(name) / file.name).replace(target)
    except OSError as error:
        raise UserError(f"{target} cannot be written ({error.strerror or error})") from None
    return target


def fetch(file: ThirdPartyFile, path: Path, target: Path) -> None:
    """Download to `path` and check it; `target` is where a person should put it who gets it by other means."""
    digest = hashlib.sha256()
    try:
        with path.open("wb") as out:
            for chunk in downloaded(file.url, file.max_bytes, file.name):
                digest.update(chunk)
                out.write(chunk)
    except DownloadFailed as error:
        raise UserError(f"cannot download {file.url} ({error}); fetch it by other means to {target}") from error
    check_sha256(file, digest.hexdigest(), file.url)


def sha256_of(path: Path, limit: int | None = None) -> str:
    """Of a file of at most `limit` bytes. Raises UserError where it cannot be read."""
    digest = hashlib.sha256()
    with open_file(path, limit) as opened:
        try:
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
