"""What the page of a folder that `avatar track` wrote has besides: the quality that it was given, and the overlay video."""

from __future__ import annotations

import base64
from pathlib import Path

from avatar.errors import UserError
from avatar.files.read import read_bytes
from avatar.html import Markup, data_table, element, section
from data_prep.formats.avatar_track import read_info, recognise

OVERLAY = Path("overlay") / "overlay.mp4"
MAX_EMBEDDED = 2**25  # bytes; a page of more than that opens slowly


def tracking_sections(folder: Path) -> list[Markup]:
    """Empty for folders of other programs."""
    if not recognise(folder):
        return []
    info = read_info(folder)
    shown = ("name", "value", "unit", "grade", "advice")
    rows = [
        [_cell(figure.get(name), name, figure.get("grade")) for name in shown]
        for figure in info.quality.get("figures", [])
        if isinstance(figure, dict)
    ]
    lens = element("p", f"Focal length: {info.focal}.", class_="soft")
    notes = [element("p", f"{note[:1].upper()}{note[1:]}.", class_="soft") for note in info.notes]
    return [section("Quality of the tracking", data_table(shown, rows), lens, *notes), *_video(folder)]


def _cell(value: object, name: str, grade: object) -> str | float | None:
    if name == "advice" and grade == "good":
        return None
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return round(float(value), 3)
    return None if value is None else str(value)


def _video(folder: Path) -> list[Markup]:
    path = folder / OVERLAY
    if not path.is_file():
        return []
    try:
        data = read_bytes(path, MAX_EMBEDDED)
    except UserError:
        return [section("The tracked mesh on every frame", element("p", f"See {path}.", class_="soft"))]
    source = f"data:video/mp4;base64,{base64.b64encode(data).decode()}"
    video = element("video", src=source, controls=True, loop=True, muted=True, preload="metadata")
    return [section("The tracked mesh on every frame", video)]
