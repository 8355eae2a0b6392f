"""The results of an evaluation as text for the terminal and as CSV."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from avatar.evaluation.held_out import View
from avatar.evaluation.protocol import MEASURES, REGIONS, column
from avatar.evaluation.results import FrameResult
from avatar.evaluation.tracking_source import LABELS, MARK, is_marked, parts, tracking_lines
from avatar.evaluation.training_coverage import Conditions

MAIN_TITLE = "by the protocol"
FORMATS = {"psnr": "7.2f", "ssim": "8.4f", "lpips": "8.4f"}
WIDTH = 80  # of a line of figures, which a terminal would break within a number
LONGEST_NAME = 24  # of a protocol, as it is shown
ITEM_TITLE = 30  # characters

Figures = Mapping[str, Any]  # one part of a protocol's entry


class Column(NamedTuple):
    """Under a title of its own: one or several cells of a line."""

    title: str
    head: str
    cells: Callable[[Figures], str]  # as wide as the head


class Line(NamedTuple):
    label: str
    frames: str
    figures: Figures | None  # None: the lines below it have them


def table(results: Mapping[str, Any]) -> str:
    """What results.json holds, for people: means side by side, intervals, bins, worst frames, what each protocol is."""
    protocols: Mapping[str, Any] = results["protocols"]
    lines = _lines(protocols, is_marked(results["tracking"]))
    level = next(iter(protocols.values()))["bootstrap"]["level"]
    tracking = tracking_lines(results["tracking"])
    name, entry = next(iter(protocols.items()))
    shown = [
        *_columns(lines, _regions(lines)),
        f"{level:.0%} intervals of the means; jitter of the head in 8-bit levels",
        *_columns(lines, _intervals(lines)),
        *_details(name, next(iter(parts(entry).values())).figures),
        "",
        *(f"{name}: {entry['choices']['summary']}" for name, entry in protocols.items()),
        *tracking,
        f"Perceptual term in training: {results['perceptual']}",
        *(f"LPIPS: {note}" for note in dict.fromkeys(entry["lpips"]["note"] for entry in protocols.values())),
        *(f"Note: {note}" for note in results["notes"] if note not in tracking),
    ]
    return "\n".join(line.rstrip() for line in shown)


def _lines(protocols: Mapping[str, Any], marked: bool) -> list[Line]:
    """One for each protocol; where the tracking was refined, below it one for each tracking, the tracker's first."""
    lines = []
    for name, entry in protocols.items():
        shown = name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 3]}..."
        own, frames = parts(entry), str(len(entry["frames"]))
        mark = f" {MARK}" if marked else ""
        if len(own) == 1:
            lines.append(Line(shown + mark, frames, entry))
        else:
            lines.append(Line(shown, frames, None))
            lines += [Line(f"  {LABELS[drive]}{mark}", "", part.figures) for drive, part in own.items()]
    return lines


def _regions(lines: Sequence[Line]) -> list[Column]:
    """Of the means that a line has, by region."""
    measured = {
        name for line in lines if line.figures for name, mean in line.figures["means"].items() if mean is not None
    }
    columns = []
    for region in (None, *REGIONS):
        names = {measure: column(measure, region) for measure in MEASURES if column(measure, region) in measured}
        if names:
            head = "".join(measure.upper().rjust(len(_cell(measure, None))) for measure in names)
            columns.append(
                Column(
                    f"{region} only" if region else MAIN_TITLE,
                    head,
                    lambda figures, names=names: "".join(
                        _cell(measure, figures["means"].get(name)) for measure, name in names.items()
                    ),
                )
            )
    return columns


def _intervals(lines: Sequence[Line]) -> list[Column]:
    columns = []
    for measure in (*MEASURES, "jitter"):
        if all(line.figures is None or line.figures["means"][measure] is None for line in lines):
            continue
        width = {"psnr": 13, "jitter": 19}.get(measure, 15)

        def cell(figures: Figures, measure: str = measure, width: int = width) -> str:
            mean = figures["means"]["jitter"]
            before = f"{mean:.2f}: " if measure == "jitter" and mean is not None else ""
            return f"{before}{_interval(measure, figures['intervals'][measure])}".rjust(width)

        columns.append(Column("", (measure if measure == "jitter" else measure.upper()).rjust(width), cell))
    return columns


def _columns(lines: Sequence[Line], columns: Sequence[Column]) -> list[str]:
    """Blocks of lines, each with as many columns as fit into `WIDTH`, and the lines that have a figure there."""
    name_width = max(len("protocol"), *(len(line.label) for line in lines))
    blocks: list[list[Column]] = []
    for one in columns:
        width = name_width + 7 + sum(3 + len(other.head) for other in (*(blocks[-1] if blocks else ()), one))
        if blocks and width <= WIDTH:
            blocks[-1].append(one)
        else:
            blocks.append([one])
    shown = []
    for block in blocks:
        if any(one.title for one in block):
            titles = "".join(f"   {one.title.center(len(one.head))}" for one in block)
            shown.append(f"{'':{name_width}} {'':>6}{titles}")
        shown.append(f"{'protocol':{name_width}} {'frames':>6}" + "".join(f"   {one.head}" for one in block))
        shown += [*_block(lines, block, name_width), ""]
    return shown


def _block(lines: Sequence[Line], block: Sequence[Column], name_width: int) -> list[str]:
    shown, waiting = [], None
    for line in lines:
        label = f"{line.label:{name_width}} {line.frames:>6}"
        if line.figures is None:
            waiting = label
            continue
        cells = [one.cells(line.figures) for one in block]
        if all(set(cell) <= set(" -") for cell in cells):
            continue
        shown += [] if waiting is None else [waiting]
        waiting = None
        shown.append(label + "".join(f"   {cell}" for cell in cells))
    return shown


def _details(name: str, part: Figures) -> list[str]:
    """How a protocol's PSNR depends on the frame; of the head where it is measured by itself."""
    figure, what = ("psnr_head", "PSNR of the head") if "psnr_head" in part["means"] else ("psnr", "PSNR")
    lines = [f"{name}, {what} (frames)"]
    for title, key in (("by yaw, degrees", "by_yaw"), ("by distance from training, mm", "by_expression_distance")):
        cells = [
            f"{_bounds(one)}: {_cell('psnr', one['means'][figure]).strip()} ({one['frames']})" for one in part[key]
        ]
        lines += _items(title, cells)
    for title, key in (("by what is held out", "by_held_out"), ("by camera and what is held out", "by_camera")):
        cells = [
            f"{one['name']}: {_cell('psnr', one['means'][figure]).strip()} ({one['frames']})"
            for one in part.get(key, ())
        ]
        lines += _items(title, cells) if cells else []
    worst = [f"{one['name']} ({one['psnr']:.2f})" for one in part["worst"]]
    return [*lines, *_items("worst frames, main PSNR", worst or ["-"])]


def _items(title: str, items: Sequence[str]) -> list[str]:
    """Items under a title, none of which is broken at the end of a line."""
    glued = "   ".join(item.replace(" ", "\0") for item in items)
    lines = textwrap.wrap(glued, WIDTH - ITEM_TITLE - 3, break_long_words=False, break_on_hyphens=False)
    heads = [title, *[""] * (len(lines) - 1)]
    return [f"  {head:{ITEM_TITLE}} {line}".replace("\0", " ") for head, line in zip(heads, lines, strict=True)]


def frames_csv(columns: Sequence[str], rows: Iterable[FrameResult], seen: Mapping[int, View] | None = None) -> str:
    """One line per frame: its index (the number of its PNG files), the name of its image, figures, conditions; with several
    cameras what it is of."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "name", *columns, *Conditions._fields, *(View._fields if seen else ())))
    for row in rows:
        values = (*(row.figures[key] for key in columns), *row.conditions)
        of = seen[row.index] if seen else ()
        writer.writerow((row.index, row.name, *(f"{value:.6f}" for value in values), *of))
    return text.getvalue()


def _cell(measure: str, value: float | None) -> str:
    width, _ = FORMATS[measure].split(".")
    return "-".rjust(int(width)) if value is None else format(value, FORMATS[measure])


def _interval(measure: str, bounds: Sequence[float] | None) -> str:
    digits = 4 if measure in ("ssim", "lpips") else 2
    return "-" if bounds is None else f"{bounds[0]:.{digits}f} - {bounds[1]:.{digits}f}"


def _bounds(part: Mapping[str, Any]) -> str:
    low, high = (None if bound is None else f"{bound:.3g}" for bound in (part["from"], part["to"]))
    if low is None or high is None:
        return f"< {high}" if low is None else f">= {low}"
    return f"{low} to {high}"
