"""The results of an evaluation as a table for the terminal and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from avatar.protocols import MEASURES, REGIONS

REGION_TITLES = {"": "full frame", "_masked": "head mask only", "_mouth": "mouth mask only"}
FORMATS = {"psnr": "7.2f", "ssim": "8.4f", "lpips": "8.4f"}


def table(results: Mapping[str, Any]) -> str:
    """The means of all protocols side by side, then what each protocol is. `results` is what results.json holds."""
    protocols: Mapping[str, Any] = results["protocols"]
    name_width = max(len("protocol"), *(len(name) for name in protocols))
    block = sum(len(_cell(measure, None)) for measure in MEASURES)
    titles = "   ".join(REGION_TITLES[region].center(block) for region in REGIONS)
    heads = "".join(measure.upper().rjust(len(_cell(measure, None))) for measure in MEASURES)
    lines = [
        f"{'':{name_width}} {'':>6}   {titles}",
        f"{'protocol':{name_width}} {'frames':>6}   {'   '.join(heads for _ in REGIONS)}",
    ]
    for name, entry in protocols.items():
        cells = (
            "".join(_cell(measure, entry["means"][measure + region]) for measure in MEASURES) for region in REGIONS
        )
        lines.append(f"{name:{name_width}} {len(entry['frames']):>6}   {'   '.join(cells)}")
    lines.append("")
    lines += [f"{name}: {entry['choices']['summary']}" for name, entry in protocols.items()]
    lines += [f"LPIPS: {note}" for note in dict.fromkeys(entry["lpips"]["note"] for entry in protocols.values())]
    lines += [f"Note: {note}" for note in results["notes"]]
    return "\n".join(line.rstrip() for line in lines)


def frames_csv(columns: Sequence[str], rows: Iterable[tuple[int, str, Mapping[str, float]]]) -> str:
    """One line per frame: its index (the number of its PNG files), the name of its image, its figures."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "name", *columns))
    for index, name, figures in rows:
        writer.writerow((index, name, *(f"{figures[column]:.6f}" for column in columns)))
    return text.getvalue()


def _cell(measure: str, value: float | None) -> str:
    width, _ = FORMATS[measure].split(".")
    return "-".rjust(int(width)) if value is None else format(value, FORMATS[measure])
