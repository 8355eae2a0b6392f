"""A comparison of runs as text for the terminal, Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path

from avatar.evaluation.bootstrap import LEVEL
from avatar.evaluation.compare import Cell, Comparison, ProtocolComparison
from avatar.evaluation.tracking_source import LABELS, MARK
from avatar.files.atomic import write_atomically

UNITS = {"psnr": "dB", "jitter": "levels"}
HIGHER_IS_BETTER = ("psnr", "ssim")
CLEAR = "*"  # beside a difference whose interval leaves out 0
LATEX_SPECIAL = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


def text(comparison: Comparison) -> str:
    """For each protocol a line per figure: the first run's mean, then each other run's with its difference to the first."""
    blocks, heads = [], _heads(comparison)
    for each in comparison.protocols:
        cells = [[_title(figure), *(_plain(figure, cell) for cell in row)] for figure, row in each.rows.items()]
        lines = [[LABELS[each.drive], *heads], *cells]
        widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
        shown = (
            "   ".join(
                [line[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True))]
            )
            for line in lines
        )
        blocks.append("\n".join([_caption(each, heads[0]), *(line.rstrip() for line in shown)]))
    return "\n\n".join([*blocks, "\n".join(_remarks(comparison))]) + "\n"


def markdown(comparison: Comparison) -> str:
    """One table a protocol."""
    heads = [label.replace("\\", "\\\\").replace("|", "\\|") for label in _heads(comparison)]
    blocks = []
    for each in comparison.protocols:
        lines = [
            f"**{_caption(each, heads[0])}**",
            "",
            f"| {LABELS[each.drive]} | {' | '.join(heads)} |",
            "|---" * (len(heads) + 1) + "|",
        ]
        for figure, row in each.rows.items():
            cells = (_plain(figure, cell).replace(CLEAR, f"\\{CLEAR}") for cell in row)
            lines.append(f"| {_title(figure)} | {' | '.join(cells)} |")
        blocks.append("\n".join(lines))
    remarks = (remark.replace(CLEAR, f"\\{CLEAR}") for remark in _remarks(comparison))
    return "\n\n".join([*blocks, *remarks]) + "\n"


def latex(comparison: Comparison) -> str:
    """One tabular a protocol, for the package booktabs."""
    heads = [_escaped(label) for label in _heads(comparison)]
    blocks = []
    for each in comparison.protocols:
        lines = [
            f"% {_caption(each, heads[0])}",
            f"\\begin{{tabular}}{{l{'r' * len(heads)}}}",
            "\\toprule",
            f"{LABELS[each.drive]} & {' & '.join(heads)} \\\\",
            "\\midrule",
        ]
        for figure, row in each.rows.items():
            arrow = "\\uparrow" if figure.startswith(HIGHER_IS_BETTER) else "\\downarrow"
            cells = (_math(figure, cell) for cell in row)
            lines.append(f"{_escaped(_title(figure))} ${arrow}$ & {' & '.join(cells)} \\\\")
        blocks.append("\n".join([*lines, "\\bottomrule", "\\end{tabular}"]))
    return "\n\n".join([*blocks, "\n".join(f"% {remark}" for remark in _remarks(comparison))]) + "\n"


def _escaped(words: str) -> str:
    return "".join(LATEX_SPECIAL.get(character, character) for character in words)


def as_csv(comparison: Comparison) -> str:
    """A line for each protocol, figure and run."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(
        ("protocol", "driven_by", "figure", "run", "count", "mean", "difference", "low", "high", "perceptual", "marked")
    )
    for each in comparison.protocols:
        for figure, row in each.rows.items():
            runs = zip(comparison.labels, row, comparison.perceptual, comparison.marked, strict=True)
            for label, cell, perceptual, marked in runs:
                numbers = (cell.mean, cell.difference, *(cell.interval or (None, None)))
                shown = ("" if number is None else f"{number:.6f}" for number in numbers)
                mark = MARK if marked else ""
                writer.writerow((each.protocol, each.drive, figure, label, each.count, *shown, perceptual, mark))
    return file.getvalue()


# Name on the command line -> suffix of the file, function.
FORMATS: dict[str, tuple[str, Callable[[Comparison], str]]] = {
    "text": ("txt", text),
    "markdown": ("md", markdown),
    "latex": ("tex", latex),
    "csv": ("csv", as_csv),
}


def write_tables(folder: Path, comparison: Comparison) -> None:
    """folder/compare.{txt,md,tex,csv}; UserError when the disk refuses."""
    for suffix, table in FORMATS.values():
        write_atomically(folder / f"compare.{suffix}", table(comparison).encode(errors="backslashreplace"))


def _heads(comparison: Comparison) -> list[str]:
    """The labels of the runs, marked where their figures are."""
    return [
        f"{label} {MARK}" if marked else label
        for label, marked in zip(comparison.labels, comparison.marked, strict=True)
    ]


def _caption(each: ProtocolComparison, first: str) -> str:
    return (
        f"{each.protocol} ({LABELS[each.drive]}): {each.count} {each.unit}, differences to {first} with {LEVEL:.0%} "
        f"intervals ({each.method})"
    )


def _remarks(comparison: Comparison) -> list[str]:
    legend = f"{CLEAR}: the interval leaves out 0. Higher is better for PSNR and SSIM, lower for LPIPS and jitter."
    terms = dict.fromkeys(comparison.perceptual)
    trained = f"Perceptual term in training: {next(iter(terms))}"
    if len(terms) > 1:
        each = zip(comparison.labels, comparison.perceptual, strict=True)
        trained = f"Perceptual terms in training differ: {', '.join(f'{label} {term}' for label, term in each)}"
    return [legend, *comparison.tracking, trained, *(f"Note: {note}" for note in comparison.notes)]


def _title(figure: str) -> str:
    measure, _, region = figure.partition("_")
    unit = f", {UNITS[measure]}" if measure in UNITS else ""
    return f"{measure if measure == 'jitter' else measure.upper()}{f' {region}' if region else ''}{unit}"


def _numbers(figure: str, cell: Cell) -> tuple[str, str, str]:
    """Mean, difference and interval; empty where there is none."""
    digits = 2 if figure.startswith(("psnr", "jitter")) else 4
    mean = f"{cell.mean:.{digits}f}"
    difference = "" if cell.difference is None else f"{cell.difference:+.{digits}f}"
    interval = "" if cell.interval is None else f"[{cell.interval[0]:+.{digits}f}, {cell.interval[1]:+.{digits}f}]"
    return mean, difference, interval


def _plain(figure: str, cell: Cell) -> str:
    mean, difference, interval = _numbers(figure, cell)
    return " ".join(part for part in (mean, difference, interval) if part) + (CLEAR if cell.is_clear else "")


def _math(figure: str, cell: Cell) -> str:
    mean, difference, interval = _numbers(figure, cell)
    if not difference:
        return f"${mean}$"
    shown = " ".join(f"${part}$" for part in (difference, interval) if part)
    return f"${mean}$ ({shown}){CLEAR if cell.is_clear else ''}"
