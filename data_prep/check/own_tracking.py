"""What the page of a folder that `avatar track` wrote has besides: the quality that it was given, and the overlay video."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path

from avatar.errors import UserError
from avatar.files.read import read_bytes
from avatar.html import Markup, data_table, element, join, section
from avatar.html.parts import data_uri
from data_prep.ffmpeg import Decoder, first_picture
from data_prep.formats.avatar_track import read_info, recognise

OVERLAY = Path("overlay") / "overlay.mp4"
_STREAM = "v:0"
MAX_EMBEDDED = 2**25  # bytes; a page of more than that opens slowly


def tracking_sections(folder: Path) -> list[Markup]:
    """Empty for folders of other programs."""
    if not recognise(folder):
        return []
    info = read_info(folder)
    shown = ("value", "unit", "grade")
    rows = [
        [_name(figure), *(_cell(figure.get(key)) for key in shown)]
        for figure in info.quality.get("figures", [])
        if isinstance(figure, dict)
    ]
    lens = element("p", f"Focal length: {info.focal}.", class_="soft")
    notes = [element("p", f"{note[:1].upper()}{note[1:]}.", class_="soft") for note in info.notes]
    return [section("Quality of the tracking", data_table(["name", *shown], rows), lens, *notes), *_video(folder)]


def _name(figure: Mapping[str, object]) -> Markup:
    """With the advice below it, where the figure needs one: a column of its own would be too narrow on a phone."""
    advice = None if figure.get("grade") == "good" else figure.get("advice")
    return join((_cell(figure.get("name")), element("div", _cell(advice), class_="soft") if advice else None))


def _cell(value: object) -> str | float | None:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return round(float(value), 3)
    return None if value is None else str(value)


def _video(folder: Path) -> list[Markup]:
    path = folder / OVERLAY
    if not path.is_file():
        return []
    try:
        data, poster = read_bytes(path, MAX_EMBEDDED), _poster(path)
    except UserError:
        return [
            section("The tracked mesh on every frame", element("p", f"See {OVERLAY} in the folder.", class_="soft"))
        ]
    source = f"data:video/mp4;base64,{base64.b64encode(data).decode()}"
    video = element("video", src=source, controls=True, loop=True, muted=True, preload="metadata", poster=poster)
    return [section("The tracked mesh on every frame", video)]


def _poster(path: Path) -> str | None:
    """The first picture: browsers show none before the video is started."""
    if (found := first_picture(path, _STREAM)) is None:
        return None
    first = next(iter(Decoder(path, _STREAM, found[0].width, found[0].height)), None)
    return None if first is None else data_uri(first.pixels)
