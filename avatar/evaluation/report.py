"""The results of an evaluation as text for the terminal and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from avatar.evaluation.conditions import Conditions
from avatar.evaluation.protocol import MEASURES, REGIONS, Region, column
from avatar.evaluation.results import FrameResult

MAIN_TITLE = "by the protocol"
FORMATS = {"psnr": "7.2f", "ssim": "8.4f", "lpips": "8.4f"}
REGIONS_BESIDE = 3  # so that a line has about 100 characters
INTERVAL_WIDTH = 18


def table(results: Mapping[str, Any]) -> str:
    """What results.json holds, for people: means side by side, intervals, bins, worst frames, what each protocol is."""
    protocols: Mapping[str, Any] = results["protocols"]
    shown: list[Region | None] = [None]
    shown += [
        region for region in REGIONS if any(region in entry["choices"]["regions"] for entry in protocols.values())
    ]
    lines: list[str] = []
    for first in range(0, len(shown), REGIONS_BESIDE):
        lines += [*_means(protocols, shown[first : first + REGIONS_BESIDE]), ""]
    lines += [*_intervals(protocols), ""]
    if any("tracked" in entry for entry in protocols.values()):
        lines += [*_tracked(protocols), ""]
    name, entry = next(iter(protocols.items()))
    lines += [*_details(name, entry), _speed(results["rendering"]), ""]
    lines += [f"{name}: {entry['choices']['summary']}" for name, entry in protocols.items()]
    lines += _tracking(results["tracking"])
    lines += [f"LPIPS: {note}" for note in dict.fromkeys(entry["lpips"]["note"] for entry in protocols.values())]
    lines += [f"Note: {note}" for note in results["notes"]]
    return "\n".join(line.rstrip() for line in lines)


def _means(protocols: Mapping[str, Any], regions: Sequence[Region | None]) -> list[str]:
    """Two lines of titles, then a line for each protocol that has one of the regions."""
    name_width = _name_width(protocols)
    width = sum(len(_cell(measure, None)) for measure in MEASURES)
    titles = "   ".join((f"{region} only" if region else MAIN_TITLE).center(width) for region in regions)
    heads = "".join(measure.upper().rjust(len(_cell(measure, None))) for measure in MEASURES)
    lines = [
        f"{'':{name_width}} {'':>6}   {titles}",
        f"{'protocol':{name_width}} {'frames':>6}   {'   '.join(heads for _ in regions)}",
    ]
    for name, entry in protocols.items():
        if {None, *entry["choices"]["regions"]}.isdisjoint(regions):
            continue
        means = entry["means"]
        cells = (
            "".join(_cell(measure, means.get(column(measure, region))) for measure in MEASURES) for region in regions
        )
        lines.append(f"{name:{name_width}} {len(entry['frames']):>6}   {'   '.join(cells)}")
    return lines


def _intervals(protocols: Mapping[str, Any]) -> list[str]:
    bootstrap = next(iter(protocols.values()))["bootstrap"]
    name_width = _name_width(protocols)
    heads = "".join(title.rjust(INTERVAL_WIDTH) for title in ("PSNR", "SSIM", "LPIPS", "jitter"))
    heads += "mean".rjust(9)
    lines = [
        f"{bootstrap['level']:.0%} intervals of the means; jitter of the head in 8-bit levels",
        f"{'protocol':{name_width}}{heads}",
    ]
    for name, entry in protocols.items():
        cells = (_interval(measure, entry["intervals"][measure]) for measure in (*MEASURES, "jitter"))
        jitter = "-" if entry["means"]["jitter"] is None else f"{entry['means']['jitter']:.2f}"
        lines.append(f"{name:{name_width}}{''.join(cells)}{jitter:>9}")
    return lines


def _tracked(protocols: Mapping[str, Any]) -> list[str]:
    """Two lines for each protocol: the same avatar and frames with the tracker's tracking and with the refined one."""
    regions: tuple[Region | None, ...] = (None, "head")
    name_width = _name_width(protocols)
    width = sum(len(_cell(measure, None)) for measure in MEASURES)
    titles = "   ".join((f"{region} only" if region else MAIN_TITLE).center(width) for region in regions)
    lines = ["the same avatar and frames by both trackings", f"{'protocol':{name_width}} {'driven by':9}   {titles}"]
    for name, entry in protocols.items():
        for title, means in (("tracked", entry["tracked"]["means"]), ("refined", entry["means"])):
            cells = (
                "".join(_cell(measure, means.get(column(measure, region))) for measure in MEASURES)
                for region in regions
            )
            lines.append(f"{name:{name_width}} {title:9}   {'   '.join(cells)}")
    return lines


def _tracking(tracking: Mapping[str, Any]) -> list[str]:
    """What the tracking of the measured frames has seen."""
    lines = [f"tracked: as {tracking['tracker']} left it; {tracking['tracked']}"]
    for one in tracking["rounds"]:
        both = one["measured_frames_trained_on"] or "none"
        lines.append(
            f"refined: each frame fitted to its own picture through the avatar of {one['run']} (step {one['step']}), which "
            f"was trained on {one['frames_trained_on']} frames, {both} of them measured"
        )
    return lines


def _details(name: str, entry: Mapping[str, Any]) -> list[str]:
    """How the first protocol's PSNR depends on the frame; of the head where it is measured by itself."""
    figure, what = ("psnr_head", "PSNR of the head") if "psnr_head" in entry["means"] else ("psnr", "PSNR")
    lines = [f"{name}, {what} (frames)"]
    for title, key in (("by yaw, degrees", "by_yaw"), ("by distance from training, mm", "by_expression_distance")):
        cells = (
            f"{_bounds(part)}: {_cell('psnr', part['means'][figure]).strip()} ({part['frames']})" for part in entry[key]
        )
        lines.append(f"  {title:30} {'   '.join(cells)}")
    worst = ", ".join(f"{part['name']} ({part['psnr']:.2f})" for part in entry["worst"])
    lines.append(f"  {'worst frames, main PSNR':30} {worst or '-'}")
    return lines


def _speed(rendering: Mapping[str, Any]) -> str:
    return (
        "Rendering at {width}x{height}: {frames_per_second:.1f} frames a second, one at a time (median of {frames}, "
        "{median_ms:.1f} ms; threads: {threads})"
    ).format_map(rendering)


def frames_csv(columns: Sequence[str], rows: Iterable[FrameResult]) -> str:
    """One line per frame: its index (the number of its PNG files), the name of its image, figures, conditions."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "name", *columns, *Conditions._fields))
    for row in rows:
        values = (*(row.figures[key] for key in columns), *row.conditions)
        writer.writerow((row.index, row.name, *(f"{value:.6f}" for value in values)))
    return text.getvalue()


def _name_width(protocols: Mapping[str, Any]) -> int:
    return max(len("protocol"), *(len(name) for name in protocols))


def _cell(measure: str, value: float | None) -> str:
    width, _ = FORMATS[measure].split(".")
    return "-".rjust(int(width)) if value is None else format(value, FORMATS[measure])


def _interval(measure: str, bounds: Sequence[float] | None) -> str:
    digits = 4 if measure in ("ssim", "lpips") else 2
    return ("-" if bounds is None else f"{bounds[0]:.{digits}f} - {bounds[1]:.{digits}f}").rjust(INTERVAL_WIDTH)


def _bounds(part: Mapping[str, Any]) -> str:
    low, high = (None if bound is None else f"{bound:.3g}" for bound in (part["from"], part["to"]))
    if low is None or high is None:
        return f"< {high}" if low is None else f">= {low}"
    return f"{low} to {high}"
