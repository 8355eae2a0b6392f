"""RUN/curves.csv: PSNR and loss of training frames as they came; written with every checkpoint."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.files.read import read_text

CURVES_FILE = "curves.csv"
LOSSES = ("total", "frame", "mouth", "perceptual")  # weighted; the first is the sum of the others
COLUMNS = ("step", "psnr", *LOSSES)  # steps from 1; dB
_MAX_BYTES = 2**26


def write_curves(run: Path, rows: Iterable[tuple[float, ...]]) -> None:
    """`rows` have COLUMNS. Raises UserError when the disk refuses."""
    lines = [
        ",".join(COLUMNS),
        *(f"{step:.0f}," + ",".join(f"{value:.6g}" for value in values) for step, *values in rows),
    ]
    write_atomically(run / CURVES_FILE, "".join(f"{line}\n" for line in lines).encode())


def read_curves(run: Path) -> Float64[np.ndarray, "N 6"]:
    """Rows of COLUMNS; none where there is no such file, or a damaged one."""
    try:
        lines = read_text(run / CURVES_FILE, _MAX_BYTES).splitlines()[1:]
        return np.array([[float(value) for value in line.split(",")] for line in lines]).reshape(-1, len(COLUMNS))
    except (UserError, ValueError):
        return np.empty((0, len(COLUMNS)))
