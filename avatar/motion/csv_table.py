"""CSV as spreadsheets and recorders write it: commas, semicolons or tabs between cells, decimal points or commas."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.errors import UserError
from avatar.head.expression_names import plain

DELIMITERS = ",;\t"  # the first wins where a header holds none
_WITH_COMMA = re.compile(r"[+-]?(\d*),(\d+)(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class Table:
    """Named columns of one length; cells are text without spaces around it."""

    path: Path
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: Sequence[int]  # of the file, one for each row
    has_decimal_commas: bool
    unnamed: int  # columns that hold something under no name; left out

    def __len__(self) -> int:
        return len(self.rows)

    def cells(self, name: str) -> list[str]:
        place = self.header.index(name)
        return [row[place] for row in self.rows]

    def column(self, name: str, largest: float) -> np.ndarray:
        """The numbers of a column. Raises UserError with line and column for a cell that is none, or beyond `largest`."""
        values = np.empty(len(self))
        for i, cell in enumerate(self.cells(name)):
            values[i] = self._number(cell)
            if not math.isfinite(values[i]):
                raise self.wrong(i, name, "not a finite number")
            if abs(values[i]) > largest:
                raise self.wrong(i, name, f"and numbers must lie within +-{largest:g}")
        return values

    def wrong(self, row: int, name: str, why: str) -> UserError:
        cell = self.rows[row][self.header.index(name)]
        return UserError(f"{self.path}, line {self.lines[row]}: {name} is {cell[:40]!r}, {why}")

    def _number(self, cell: str) -> float:
        if self.has_decimal_commas and _WITH_COMMA.fullmatch(cell):
            cell = cell.replace(",", ".")
        try:
            return float(cell)
        except ValueError:
            return math.nan


def own_name(column: str) -> str:
    """Plain, without what programs put before it: blendShapes.JawOpen."""
    return plain(column.rpartition(".")[2])


def parse_table(path: Path, data: bytes) -> Table:
    """The table of a file's content. Raises UserError, naming file and line, for what is none.

    Lines without a cell, and cells at the end of lines that have neither a name nor a value, do not count. A column
    without a name is left out.
    """
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
        lines = _parse(text)
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} cannot be read as CSV ({error})") from None
    if len(lines) < 2:
        raise UserError(f"{path} needs a line of column names and at least one frame")
    names = lines[0][1]
    if all(map(_is_number, filter(None, names))):
        raise UserError(f"{path}, line {lines[0][0]} holds numbers: the first line must name the columns")
    if double := [name for name, count in Counter(map(plain, filter(None, names))).items() if count > 1]:
        raise UserError(f"{path} has two columns of the name {double[0]}")
    width = max(i for i, name in enumerate(names, start=1) if name)
    for number, row in lines[1:]:
        filled = max((i for i, cell in enumerate(row, start=1) if cell), default=0)
        if len(row) < width or filled > len(names):
            raise UserError(f"{path}, line {number}: {len(row)} values for {width} columns")
    named = [i for i, name in enumerate(names) if name]
    rows = [[row[i] for i in named] for _, row in lines[1:]]
    header = [names[i] for i in named]
    unnamed = sum(
        not name and any(row[i : i + 1] not in ([], [""]) for _, row in lines[1:]) for i, name in enumerate(names)
    )
    return Table(path, header, rows, [number for number, _ in lines[1:]], _decimal_commas(rows), unnamed)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return _WITH_COMMA.fullmatch(cell) is not None
    return True


def _parse(text: str) -> list[tuple[int, list[str]]]:
    """The lines that hold anything, with their numbers."""
    lines = text.splitlines()
    delimiter = None
    if lines and (match := re.fullmatch(r"sep=([,;\t|])\s*", lines[0], re.IGNORECASE)):  # as spreadsheets write it
        delimiter, lines[0] = match[1], ""
    first = next((line for line in lines if line.strip()), "")
    if delimiter is None:
        delimiter = max(DELIMITERS, key=lambda one: len(next(csv.reader([first], delimiter=one), ())))
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    cells = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    return [(number, row) for number, row in cells if any(row)]


def _decimal_commas(rows: Sequence[Sequence[str]]) -> bool:
    """Whether a comma in a number is decimal. Where every one of them may stand between thousands, nobody knows."""
    found = [match for row in rows for cell in row if (match := _WITH_COMMA.fullmatch(cell))]
    return any(len(match[2]) != 3 or not match[1].strip("0") or len(match[1]) > 3 for match in found)
