"""The results of an evaluation as a table for the terminal and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from avatar.evaluation.protocol import COLOURS, MEASURES, REGIONS, Region, column

MAIN_TITLE = "by the protocol"
FORMATS = {"psnr": "7.2f", "ssim": "8.4f", "lpips": "8.4f"}
REGIONS_BESIDE = 3  # so that a line has about 100 characters


def table(results: Mapping[str, Any]) -> str:
    """The means of all protocols side by side, then what each protocol is. `results` is what results.json holds."""
    protocols: Mapping[str, Any] = results["protocols"]
    shown: list[Region | None] = [None]
    shown += [
        region for region in REGIONS if any(region in entry["choices"]["regions"] for entry in protocols.values())
    ]
    lines: list[str] = []
    for first in range(0, len(shown), REGIONS_BESIDE):
        lines += [*_block(protocols, shown[first : first + REGIONS_BESIDE]), ""]
    lines += [f"{name}: {entry['choices']['summary']}" for name, entry in protocols.items()]
    lines += [f"LPIPS: {note}" for note in dict.fromkeys(entry["lpips"]["note"] for entry in protocols.values())]
    lines += [f"Note: {note}" for note in results["notes"]]
    return "\n".join(line.rstrip() for line in lines)


def _block(protocols: Mapping[str, Any], regions: Sequence[Region | None]) -> list[str]:
    """Two lines of titles, then a line for each protocol that has one of the regions."""
    name_width = max(len("protocol"), *(len(name) for name in protocols))
    width = sum(len(_cell(measure, None)) for measure in MEASURES)
    titles = "   ".join((f"{region} only" if region else MAIN_TITLE).center(width) for region in regions)
    heads = "".join(measure.upper().rjust(len(_cell(measure, None))) for measure in MEASURES)
    lines = [
        f"{'':{name_width}} {'':>6}   {titles}",
        f"{'protocol':{name_width}} {'frames':>6}   {'   '.join(heads for _ in regions)}",
    ]
    for name, entry in protocols.items():
        if not {None, *entry["choices"]["regions"]}.intersection(regions):
            continue
        means = entry["means"]
        cells = (
            "".join(_cell(measure, means.get(column(measure, region))) for measure in MEASURES) for region in regions
        )
        lines.append(f"{name:{name_width}} {len(entry['frames']):>6}   {'   '.join(cells)}")
    return lines


def frames_csv(columns: Sequence[str], rows: Iterable[tuple[int, str, Mapping[str, float]]]) -> str:
    """One line per frame: its index (the number of its PNG files), the name of its image, its figures."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "name", *columns))
    for index, name, figures in rows:
        writer.writerow((index, name, *(f"{figures[key]:.6f}" for key in columns)))
    return text.getvalue()


def colour_name(colour: Sequence[float]) -> str:
    """`white` where a colour has a name, else its values."""
    return next((name for name, values in COLOURS.items() if values == tuple(colour)), str(list(colour)))


def _cell(measure: str, value: float | None) -> str:
    width, _ = FORMATS[measure].split(".")
    return "-".rjust(int(width)) if value is None else format(value, FORMATS[measure])
