"""RUN/report.html: figures, curves, held-out frames and configuration of a run in one file."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from avatar.config import flatten
from avatar.data.read_image import MAX_BYTES
from avatar.errors import check_installed
from avatar.evaluation.compare import read_evaluation
from avatar.evaluation.tracking_source import LABELS, MARK, is_marked, parts, tracking_lines
from avatar.files.atomic import write_atomically
from avatar.files.names import RUN_FOLDER, display_name, display_path, typed
from avatar.files.read import is_there, read_bytes
from avatar.html import Markup, data_table, document, element, figure_of, fold, join, plot, section, tiles
from avatar.html.document import Content
from avatar.html.parts import NOTHING, SERIES, data_uri
from avatar.report.grade import Word, describe, word_of
from avatar.report.pictures import frame_panels
from avatar.runs.run import Run, versions
from avatar.runs.training_curves import read_curves

MAIN = {
    "psnr": ("PSNR, dB", "\N{UPWARDS ARROW} higher"),
    "ssim": ("SSIM", "\N{UPWARDS ARROW} higher"),
    "lpips": ("LPIPS", "\N{DOWNWARDS ARROW} lower"),
}
BADGES: dict[Word, str] = {"good": "fine", "fair": "warning", "poor": "error"}
SHOWN_DECIMALS = {"psnr": 2}  # others: 4
BINNINGS = (  # key of results.json, what it is binned by, decimals of the edges and their column's name
    ("by_held_out", "what is held out", 0, "held out"),  # of several cameras, as the next
    ("by_camera", "camera", 0, "camera, and what is held out"),
    ("by_yaw", "yaw", 0, "degrees of yaw"),
    ("by_expression_distance", "distance from the training expressions", 2, "mm"),
)
MAX_POINTS = 1000  # of a curve
PAGE = "avatar.html"
SCRIPT = """
const slider = document.getElementById("frame");
const panels = [...document.querySelectorAll("#frames figure")];
function show() {
  panels.forEach((panel, i) => { panel.hidden = i !== Number(slider.value); });
  slider.setAttribute("aria-valuetext", panels[slider.value].textContent);
}
if (slider) { slider.addEventListener("input", show); show(); }
"""


def write_report(run: Run) -> Path:
    """Write RUN/report.html and return it. Parts that a run does not have yet (its evaluation, its curves) are named as
    missing. Raises UserError when the evaluation's results cannot be read, a frame is gone, or a package is missing."""
    check_installed("a report", "plots", "matplotlib")
    path = run.path / "report.html"
    write_atomically(path, render_report(run).encode())
    return path


def render_report(run: Run) -> str:
    is_measured = is_there(run.path / "eval" / "results.json")
    results = read_evaluation(run.path.name, run.path).results if is_measured else None
    facts = {
        "subject": run.subject.name,
        "method": run.config.model.name,
        "perceptual term": run.trained.perceptual,
        "Gaussians": f"{len(run.avatar):,}",
        "step": f"{run.step:,}",
        "training frames": len(run.subject.split.train),
        "held-out frames": len(run.subject.split.test),
    }
    folder, link = run.path.resolve(), ""
    title = f"Run {display_name(folder)}"
    if folder.name == RUN_FOLDER and is_there(folder.parent / PAGE):  # as avatar create and demo lay them out
        link = element("p", element("a", "The avatar in its page", href=f"../{PAGE}"))
    parts = [
        element("header", element("h1", title), link),
        section("Held-out frames", *_main_figures(results), *_frames(run)),
        section("Held-out figures", *_figures(run, results)),
        section("Training", fold("Loss and PSNR", *_curves(run.path))),
        section("Run", tiles(facts), fold("Origin", *_origin(run, results))),
    ]
    return document(title, parts, SCRIPT)


def _main_figures(results: Mapping[str, Any] | None) -> list[Markup]:
    """Of the first protocol that has them, of the head where it measures that."""
    for name, entry in (results or {}).get("protocols", {}).items():
        means = next(iter(parts(entry).values())).figures.get("means", {})
        what = "_head" if "psnr_head" in means else ""
        shown = {column: value for column in MAIN if (value := means.get(f"{column}{what}")) is not None}
        if not shown:
            continue
        network, scale = entry["lpips"].get("network"), entry.get("choices", {}).get("lpips_scale", 1.0)
        figures = {column: f"{column} {network}" if column == "lpips" else column for column in shown}
        words: dict[str, Word | None] = {
            column: word_of(figure, shown[column]) if what and (column != "lpips" or scale == 1.0) else None
            for column, figure in figures.items()
        }
        labels = {
            f"{MAIN[column][0]}, {MAIN[column][1]} is better": _judged(_figure(column, value), words[column])
            for column, value in shown.items()
        }
        meant = "; ".join(describe(figures[column]) for column, word in words.items() if word)
        said = f"Means by the protocol {name}{what and ', of the head'}.{meant and f' {meant}.'}"
        return [tiles(labels), element("p", said, class_="soft")]
    return []


def _judged(figure: str, word: Word | None) -> Content:
    return join((figure, " ", element("span", word, class_=f"badge {BADGES[word]}"))) if word else figure


def means_table(protocols: Mapping[str, Any], mark: str = "") -> Markup:
    """One line per protocol and tracking, the tracker's first; one column per figure."""
    lines = _by_drive(protocols, mark)
    columns = list(dict.fromkeys(c for _, _, means, _ in lines for c in means))
    rows = [[name, frames, *(_figure(c, means.get(c)) for c in columns)] for name, frames, means, _ in lines]
    return data_table(["protocol", "frames", *(column.replace("_", " ") for column in columns)], rows)


def bins_tables(protocols: Mapping[str, Any], mark: str = "") -> list[Markup]:
    """Means over the frames in each bin of the conditions that a protocol was binned by, one table for each pair."""
    tables = []
    for name, _, means, figures in _by_drive(protocols, mark):
        for key, title, decimals, column_name in BINNINGS:
            bins = figures.get(key, ())
            if not bins:
                continue
            rows = [
                [_interval(one, decimals), one["frames"], *(_figure(c, one["means"].get(c)) for c in means)]
                for one in bins
            ]
            heading = [column_name, "frames", *(column.replace("_", " ") for column in means)]
            tables.append(element("div", element("p", f"{name}, by {title}", class_="soft"), data_table(heading, rows)))
    return tables


def _by_drive(
    protocols: Mapping[str, Any], mark: str
) -> list[tuple[str, int, Mapping[str, float | None], Mapping[str, Any]]]:
    """Name, number of frames, means and all figures of each protocol, by the tracker's tracking and the refined one."""
    lines = []
    for name, entry in protocols.items():
        own, frames = parts(entry), len(entry.get("frames", ()))
        for drive, part in own.items():
            label = name if len(own) == 1 else f"{name}, {LABELS[drive]}"
            lines.append((label + mark, frames, part.figures.get("means", {}), part.figures))
    return lines


def _interval(one: Mapping[str, Any], decimals: int) -> str:
    if "name" in one:
        return str(one["name"])
    low, high = (None if one[side] is None else f"{one[side]:.{decimals}f}" for side in ("from", "to"))
    return f"below {high}" if low is None else f"{low} or more" if high is None else f"{low} to {high}"


def _figure(column: str, value: float | None) -> str:
    return NOTHING if value is None else f"{value:.{SHOWN_DECIMALS.get(column.partition('_')[0], 4)}f}"


def _figures(run: Run, results: Mapping[str, Any] | None) -> list[Markup]:
    if results is None:
        return [element("p", f"Not measured yet: avatar eval {typed(run.path)}", class_="soft")]
    shown = []
    if results.get("step") != run.step:
        text = f"Measured at step {results.get('step')}, while the newest checkpoint is of step {run.step}."
        shown.append(element("p", text, class_="finding warning"))
    tracking, protocols = results["tracking"], results["protocols"]
    mark = f" {MARK}" if is_marked(tracking) else ""
    shown.append(means_table(protocols, mark))
    kind = "finding warning" if tracking["rounds"] else "soft"
    rounds = [{**one, "run": display_path(Path(one["run"]))} for one in tracking["rounds"]]
    shown += [element("p", line, class_=kind) for line in tracking_lines({**tracking, "rounds": rounds})]
    networks = dict.fromkeys(entry["lpips"]["note"] for entry in protocols.values())
    shown += [element("p", f"LPIPS: {note}", class_="soft") for note in networks]
    shown.append(fold("By head pose and by distance from the training expressions", *bins_tables(protocols, mark)))
    by_tracker = ", driven by the tracker's tracking" if tracking["rounds"] else ""
    captions = (
        ("curves.png", f"The figures along the video{by_tracker}"),
        ("worst.png", f"The worst frames{by_tracker}"),
    )
    for name, caption in captions:
        file = run.path / "eval" / name
        if is_there(file):
            source = f"data:image/png;base64,{base64.b64encode(read_bytes(file, MAX_BYTES)).decode()}"
            kind = "plot" if name == "curves.png" else None
            image = element("img", src=source, alt=caption)
            shown.append(fold(caption, element("figure", image, element("figcaption", caption), class_=kind)))
    choices = {n: e.get("choices", {}).get("summary") for n, e in protocols.items()}
    rows = [[name, summary] for name, summary in choices.items()]
    return [*shown, fold("What each protocol measures", data_table([], rows))]


def _frames(run: Run) -> list[Markup]:
    panels = frame_panels(run)
    figures = [
        element(
            "figure",
            element("img", src=data_uri(image), alt=name),
            element("figcaption", f"frame {name}"),
            hidden=position > 0,
        )
        for position, (name, image) in enumerate(panels)
    ]
    by_tracker = [] if run.subject.given is None else [element("p", "Driven by the tracker's tracking.", class_="soft")]
    slider = element("input", type="range", id="frame", min=0, max=len(panels) - 1, value=0, aria_label="frame")
    return [*by_tracker, element("div", slider, join(figures), id="frames")]


def _curves(run: Path) -> list[Markup]:
    curves = read_curves(run)
    steps, psnr, loss, *_ = curves[:: max(1, -(-len(curves) // MAX_POINTS))].T
    if len(steps) == 0:
        return [element("p", "No curves were recorded.", class_="soft")]
    plots = []
    for title, scale, values in (("loss", "log", loss), ("PSNR, dB", "linear", psnr)):
        figure, axes = figure_of()
        axes.plot(steps, values, color=SERIES[0], linewidth=0.9)
        axes.set(xlabel="step", ylabel=title, yscale=scale)
        plots.append(plot(figure, f"{title[:1].upper()}{title[1:]} of the training frames as they came", title))
    return [element("div", *plots, class_="plots")]


def _origin(run: Run, results: Mapping[str, Any] | None) -> list[Markup]:
    known = {
        "data hash": run.subject.data_hash,
        "head model": run.avatar.head.assets.fingerprint,
        **{f"version of {name}": value for name, value in versions().items()},
    }
    lines = tracking_lines(results["tracking"]) if results else []
    notes = [element("p", note) for note in (results or {}).get("notes", ()) if note not in lines]
    config = [[key, str(value)] for key, value in flatten(run.config.to_dict()).items()]
    return [*notes, data_table([], [list(row) for row in known.items()]), fold("Configuration", data_table([], config))]
