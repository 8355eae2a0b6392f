"""What pages are made of: tables, tiles, pictures, plots."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from avatar.errors import check_installed
from avatar.html.document import Content, Markup, element

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NOTHING = "-"  # in a table: there is no such figure
INK, GRID = "#1d2733", "#d9dee5"  # of style.css
JPEG_QUALITY = 85
SERIES = ("#2563a8", "#c4572b", "#3d8a5c", "#7a4fa3")  # colours of lines and points, readable by the colour-blind


def data_table(head: Sequence[Content], rows: Iterable[Sequence[Content]]) -> Markup:
    """A table whose cells that are numbers stand to the right; where it is too wide, the arrow keys scroll it.

    Columns in which no row has anything are left out.
    """
    rows = list(rows)
    empty = {at for at, cells in enumerate(zip(*rows, strict=True)) if all(cell in (None, NOTHING) for cell in cells)}

    def line(tag: str, cells: Sequence[Content]) -> Markup:
        kept = (cell for at, cell in enumerate(cells) if at not in empty)
        return element("tr", *(element(tag, cell, class_=_kind(cell)) for cell in kept))

    heading = element("thead", line("th", head)) if head else ""
    table = element("table", heading, element("tbody", *(line("td", row) for row in rows)))
    return element("div", table, class_="scroll", tabindex=0, role="group", aria_label="table")


def tiles(values: Mapping[str, Content]) -> Markup:
    """Name and value pairs as a grid of small cards."""
    return element(
        "dl",
        *(element("div", element("dt", name), element("dd", value)) for name, value in values.items()),
        class_="tiles",
    )


def fold(summary: Content, *content: Content) -> Markup:
    """Content that opens with a click."""
    return element("details", element("summary", summary), *content)


def picture(image: np.ndarray, caption: Content = None) -> Markup:
    """A figure of a uint8 image [H, W, 3] (red first) or [H, W]."""
    caption_text = element("figcaption", caption) if caption else ""
    return element("figure", element("img", src=data_uri(image), alt=caption or ""), caption_text)


def data_uri(image: np.ndarray) -> str:
    """A uint8 image [H, W, 3] or [H, W] as a JPEG inside a URL."""
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(encoded).decode()}"


def figure_of() -> tuple[Figure, Axes]:
    """A matplotlib figure in the page's style and its axes."""
    check_installed("a plot", "plots", "matplotlib")
    from matplotlib.figure import Figure  # takes half a second

    figure = Figure(figsize=(5.4, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GRID)
    axes.tick_params(colors=INK, labelsize=8, length=0)
    axes.xaxis.label.set(color=INK, fontsize=9)
    axes.yaxis.label.set(color=INK, fontsize=9)
    return figure, axes


def plot(figure: Figure, caption: Content = None, alt: str = "plot") -> Markup:
    """A matplotlib figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=144, facecolor="white")
    source = f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"
    caption_text = element("figcaption", caption) if caption else ""
    return element("figure", element("img", src=source, alt=alt), caption_text, class_="plot")


def section(title: str, *content: Content) -> Markup:
    return element("section", element("h2", title), *content)


def _kind(cell: Content) -> str | None:
    return "number" if isinstance(cell, (int, float)) and not isinstance(cell, bool) else None
