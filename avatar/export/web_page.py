"""`avatar export RUN --format web`: one HTML file in which the avatar lives, without a network or a server."""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
from dataclasses import dataclass
from pathlib import Path

from avatar.errors import UserError
from avatar.export.licence import SKINNING, licence_of
from avatar.export.web_file import Precision, encode_avatar
from avatar.files.atomic import write_atomically
from avatar.runs.trained_avatar import TrainedAvatar

WEB = Path(__file__).resolve().parents[1] / "web"
SLOW_NODES = 2000  # places at which the network is evaluated; above, a picture takes longer than it should
PAGE_MODULES = (
    *("core.js", "motion.js", "canvas.js", "webgl_renderer.js", "drive.js", "settings.js", "view.js"),
    *("orbit_controls.js", "landmarker.js", "camera.js", "controls.js", "gaze.js", "page_display.js"),
    *("camera_panel.js", "page.js"),
)
WORKER_MODULES = ("core.js", "worker.js")
LANDMARKER_WORKER_MODULES = ("landmarker_worker.js",)


@dataclass(frozen=True)
class WebPage:
    path: Path
    bytes: int
    avatar_bytes: int
    note: str  # what a person should know before passing it on; empty for nothing


def write_page(trained: TrainedAvatar, out: Path, precision: Precision = "small", *, webcam: bool = False) -> WebPage:
    """Write the page. With `webcam` it offers the reader's camera; the landmarker has to lie beside it then.

    Raises UserError when a part of the installation is missing or the disk refuses.
    """
    encoded = encode_avatar(trained, precision)
    parts = {
        "title": html.escape(trained.name),
        "webcam": " data-webcam" if webcam else "",
        "licence": html.escape(licence_of(SKINNING)),
        "style": read("page.css"),
        "script": f"(() => {{\n{bundle(PAGE_MODULES)}\n}})();",
        "worker": script_text(json.dumps(bundle(WORKER_MODULES), allow_nan=False)),
        "watcher": script_text(json.dumps(bundle(LANDMARKER_WORKER_MODULES), allow_nan=False)),
        "module": base64.b64encode(gzip.compress((WEB / "avatar.wasm").read_bytes(), 9, mtime=0)).decode(),
        "data": base64.b64encode(encoded.data).decode(),
    }
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], read("page.html"))
    data = page.encode()
    write_atomically(out, data)
    nodes = encoded.drawing.sizes["nodes"]
    note = ""
    if nodes > SLOW_NODES:
        note = (
            f"its network is evaluated at {nodes:,} places for every picture, which is slow in a browser; models with a "
            "latent grid are not"
        )
    return WebPage(out, len(data), len(encoded.data), note)


def write_web_avatar(trained: TrainedAvatar, out: Path, precision: Precision = "small") -> int:
    """Write the file that <avatar-view src> takes; its size in bytes."""
    data = encode_avatar(trained, precision).data
    write_atomically(out, data)
    return len(data)


def read(name: str) -> str:
    try:
        return (WEB / name).read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"the installation lacks {WEB / name} ({error.strerror}); install the program again") from None


def bundle(names: tuple[str, ...]) -> str:
    """Modules as one script: their imports of each other are met by what stands before them."""
    parts = []
    for name in names:
        text = re.sub(r"^import\s[^;]*;\n", "", read(name), flags=re.MULTILINE)
        parts.append(re.sub(r"^export (?=(?:async )?(?:function|class|const))", "", text, flags=re.MULTILINE))
    return script_text("\n".join(parts))


def script_text(text: str) -> str:
    """Text that cannot end a script element."""
    return text.replace("</", "<\\/")
