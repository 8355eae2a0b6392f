"""The page that `avatar check --out` writes."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from avatar.errors import UserError
from avatar.files.names import display_name
from avatar.files.read import open_file
from avatar.html import Markup, document, element, fold, join, picture, section, tiles
from avatar.version import __version__
from data_prep.check.clip import Clip
from data_prep.check.findings import Finding
from data_prep.check.folder import Check, facts
from data_prep.check.overlay import draw_overlays
from data_prep.check.own_tracking import tracking_sections
from data_prep.check.plots import course_plots, coverage_plots

PAGE, TABLE = "index.html", "frames.csv"
_BADGES = ("fine", "warning", "error")  # by exit status
_MAIN = ("usable frames", "overlap of mesh and head mask (IoU), median", "lips to mouth mask, median, pixels")
_FIT_COLUMNS = ("overlap", "inside", "overhang", "mouth", "mask_ratio", "size")


def check_page_output(out: Path) -> None:
    """Raise UserError where a file is there that no earlier check has written."""
    page, ours = out / PAGE, False
    if page.exists():
        with open_file(page, None) as file:
            ours = b"<title>Check of " in file.read(20_000)
    there = next((path for path in (page, out / TABLE) if path.exists()), None)
    if there is not None and not ours:
        raise UserError(f"{there} is not of avatar check and would be overwritten; choose another --out")


def write_page(check: Check, out: Path) -> Path:
    """Write OUT/index.html, which needs nothing else, and OUT/frames.csv; returns the page."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        page = out / PAGE
        page.write_text(render_page(check), encoding="utf-8", errors="replace")  # names may be none of UTF-8
        if check.clip is not None:
            write_frames(check.clip, out / TABLE)
    except OSError as error:
        raise UserError(f"the page cannot be written to {out} ({error.strerror}); choose another --out") from error
    return page


def render_page(check: Check) -> str:
    title, badge = f"Check of {display_name(check.folder.resolve())}", _BADGES[check.status]
    verdict = element("a", check.summary(), href="#findings") if check.findings else check.summary()
    header = element(
        "header",
        element("h1", title),
        element("p", element("span", badge, class_=f"badge {badge}"), " ", verdict, class_="verdict"),
    )
    parts: list[Markup] = [header]
    figures = {} if check.clip is None else facts(check.clip, check.coverage)
    if check.clip is not None:
        parts += _pictures(check.clip, {name: _shown(figures[name]) for name in _MAIN if name in figures})
    parts.append(element("section", element("h2", "Findings"), *_findings(check), id="findings"))
    if check.clip is not None:
        parts += tracking_sections(check.clip.files.folder)
        if check.coverage is not None:
            plots = [*coverage_plots(check.coverage), *course_plots(check.clip)]
            parts.append(section("Coverage and course", element("div", *plots, class_="plots")))
        evidence = _shown(figures.pop("offset found"))
        shown = tiles({name: _shown(value) for name, value in figures.items()})
        parts.append(section("Figures", element("p", f"Offset: {evidence}.", class_="soft"), shown))
    parts.append(element("p", f"avatar {__version__} check", class_="soft"))
    return document(title, parts)


def write_frames(clip: Clip, path: Path) -> None:
    """One line per image: what was measured of it; empty where it could not be."""
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("image", "change", "covered", "haze", "holes", "specks", *_FIT_COLUMNS))
        for number, view in clip.views.items():
            matte = [getattr(view.matte, name, None) for name in ("covered", "haze", "holes", "specks")]
            fit = [getattr(clip.fits.get(number), name, None) for name in _FIT_COLUMNS]
            values = (clip.steps.get(number), *matte, *fit)
            cells = ("" if v is None or np.isnan(v) else f"{v:.5f}" for v in values)
            writer.writerow((clip.image_name(number), *cells))


def _findings(check: Check) -> list[Markup]:
    if not check.findings:
        return [element("p", "Nothing was found that could spoil training.")]
    return [_finding(finding) for finding in check.findings]


def _finding(finding: Finding) -> Markup:
    listed = fold(f"{len(finding.frames)} names", element("p", ", ".join(finding.frames))) if finding.frames[1:] else ""
    return element(
        "div",
        element("span", finding.severity, class_="badge"),
        " ",
        element("code", finding.check),
        element("p", element("strong", f"{finding.problem[:1].upper()}{finding.problem[1:]}.")),
        element("p", f"{finding.advice[:1].upper()}{finding.advice[1:]}.", class_="soft"),
        listed,
        class_=f"finding {finding.severity}",
    )


def _pictures(clip: Clip, main_figures: Mapping[str, str]) -> list[Markup]:
    """The frames under the main figures; empty where nothing can be drawn."""
    overlays = draw_overlays(clip)
    if not overlays:
        return []
    key = join(
        join((element("span", class_=f"key {name}"), title))
        for name, title in (
            ("mesh", "tracked mesh"),
            ("mask", "head mask"),
            ("lips", "tracked lips"),
            ("mouth", "mouth mask"),
        )
    )
    images = [picture(image, caption) for image, caption in overlays]
    text = "Half of the frames are spread over the clip, half are those that fit worst."
    gallery = element("div", *images, class_="gallery")
    words = element("p", text, key, class_="soft")
    return [section("The tracked head on the frames", tiles(main_figures), words, gallery)]


def _shown(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else "unknown" if value is None else str(value)
