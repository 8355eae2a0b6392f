"""PSNR, SSIM and jitter computed a second time, by scikit-image, from the PNG files that an evaluation has written.

Nothing of the first computation is used: other code reads the files, weighs the masks and runs the windows of SSIM. What
agrees can be recomputed by anybody who has the pictures. LPIPS is left out: it needs the weights of its network.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from skimage.io import imread
from skimage.metrics import structural_similarity
from tqdm import tqdm

from avatar.data.read_image import MAX_BYTES
from avatar.errors import UserError
from avatar.evaluation.pictures import MASK_FOLDERS, RENDERS
from avatar.evaluation.previous_results import MAX_TABLE_BYTES
from avatar.evaluation.protocol import column
from avatar.evaluation.tracking_source import Part, parts
from avatar.files.atomic import write_atomically
from avatar.files.read import read_bytes, read_json

TOLERANCE = 2e-6  # frames.csv is rounded to 5e-7; both sides compute in float64
_LEVELS = 255
_RADIUS = 5  # of SSIM's window of 11 x 11: a window whose centre is nearer to the border does not count

Figures = dict[str, float]  # by column of frames.csv


class Difference(NamedTuple):
    size: float
    figure: str
    where: str  # "frame 00012" or "the mean"


def verify(results: Path, protocols: Sequence[str] | None = None, say: Callable[[str], None] = print) -> None:
    """Check RUN/eval/results.json and the tables of frames against the pictures; note in results.json that they agree.

    protocols  names; None: all that results.json has
    Says one line for each protocol and tracking. Raises UserError naming the first frame and figure that differ by more
    than `TOLERANCE`, a picture that is missing, or a table that results.json was not made from.
    """
    summary = _again(lambda: read_json(results))
    for name, entry in summary["protocols"].items():
        if protocols is not None and name not in protocols:
            continue
        if entry["choices"]["levels"] == "float":
            say(f"{name}: not verified, because it measures floats, which no PNG file holds (levels: float)")
            continue
        own = parts(entry)
        for drive, part in own.items():
            worst, frames = verify_part(results.parent / name, entry["choices"], part)
            part.figures["verified"] = {
                "by": f"scikit-image {version('scikit-image')}",
                "frames": frames,
                "tolerance": TOLERANCE,
                "largest_difference": worst.size,
            }
            title = name if len(own) == 1 else f"{name}, {drive}"
            say(
                f"{title}: PSNR, SSIM and jitter of {frames} frames verified from their pictures; "
                f"largest difference {worst.size:.1e} ({worst.figure} of {worst.where})"
            )
    write_atomically(results, json.dumps(summary, indent=2, allow_nan=False).encode())


def verify_part(folder: Path, choices: Mapping[str, Any], part: Part) -> tuple[Difference, int]:
    """The largest difference between a protocol's figures by one tracking and its pictures, and the number of frames.

    Raises as `verify` does.
    """
    table = folder / part.table
    content = _again(lambda: read_bytes(table, MAX_TABLE_BYTES))
    if hashlib.sha256(content).hexdigest() != part.figures["frames_sha256"]:
        raise UserError(f"{table} is not the table that results.json was made from; evaluate again")
    rows = list(csv.DictReader(io.StringIO(content.decode())))
    place = {_place(row): int(row["frame"]) for row in rows}
    seen: list[Figures] = []
    worst = Difference(0.0, "psnr", f"frame {rows[0]['name']}")
    for row in tqdm(rows, desc=f"verify {folder.name}", unit="frame", leave=False, disable=None):
        figures = recompute(folder, int(row["frame"]), choices, part.renders)
        # Which frames follow each other in time is not in the pictures, so the table says which have a jitter.
        has_jitter = not math.isnan(float(row["jitter"]))
        camera, time = _place(row)
        around = [place.get((camera, time + step)) for step in (-1, 0, 1)] if has_jitter else []
        known = [number for number in around if number is not None]
        figures["jitter"] = recompute_jitter(folder, known, part.renders) if len(known) == 3 else math.nan
        seen.append(figures)
        for found in differences({name: float(row[name]) for name in figures}, figures, f"frame {row['name']}", table):
            worst = max(worst, found)
    means = {name: _mean([figures[name] for figures in seen]) for name in seen[0]}
    given = part.figures["means"]
    recorded = {name: math.nan if given[name] is None else given[name] for name in means}
    for found in differences(recorded, means, "the mean", folder.parent / "results.json"):
        worst = max(worst, found)
    return worst, len(rows)


def differences(recorded: Figures, seen: Figures, where: str, file: Path) -> Iterator[Difference]:
    """Of each figure that both have. Raises UserError for one that is too large, or that only one side has."""
    for name, value in seen.items():
        if recorded[name] == value or (math.isnan(recorded[name]) and math.isnan(value)):
            continue
        size = abs(recorded[name] - value)
        if not size <= TOLERANCE:  # a NaN on one side only is too large
            raise UserError(
                f"{name} of {where} is {recorded[name]:.6f} in {file}, but its pictures give {value:.6f} "
                f"({size:.1e} apart, {TOLERANCE:g} allowed): a file was changed, or a figure is wrong; evaluate again"
            )
        yield Difference(size, name, where)


def recompute(folder: Path, index: int, choices: Mapping[str, Any], renders: str = RENDERS) -> Figures:
    """PSNR and SSIM of one frame, main and by region, by column of frames.csv; NaN for a region without a pixel.

    choices  of the protocol: `mask` and `regions`
    renders  the folder of the renders
    """
    render, truth, head = (_read(folder / kind / f"{index:05d}.png") for kind in (renders, "gt", "masks"))
    whole = np.ones_like(head)
    if choices["mask"] == "multiply":
        weight = head[..., None] / _LEVELS
        figures = _weighted_figures(render * weight, truth * weight, {None: whole})
    else:
        figures = _weighted_figures(render, truth, {None: head if choices["mask"] == "only" else whole})
    masks = {region: _mask(folder, region, index, head.shape) for region in choices["regions"]}
    return figures | _weighted_figures(render, truth, masks)


def _place(row: Mapping[str, str]) -> tuple[str, int]:
    """Camera and time of a line of frames.csv; with one camera the frames follow each other in time."""
    return row.get("camera", ""), int(row.get("time", row["frame"]))


def recompute_jitter(folder: Path, indices: Sequence[int], renders: str = RENDERS) -> float:
    """Jitter of a frame, from its index between those before and after it, levels of 8 bits; NaN where no pixel is in all
    three masks."""
    errors, masks = [], []
    for number in indices:
        render, truth, head = (_read(folder / kind / f"{number:05d}.png") for kind in (renders, "gt", "masks"))
        errors.append(render - truth)
        masks.append(head)
    return _weighted(np.abs(np.diff(errors, n=2, axis=0)[0]).mean(axis=2), np.min(masks, axis=0))


def _weighted_figures(
    render: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"], masks: Mapping[str | None, np.ndarray]
) -> Figures:
    """Weighted means of squared error and of the SSIM map, by column of frames.csv; None is the main figure."""
    if not masks:
        return {}
    error = np.square((render - truth) / _LEVELS).mean(axis=2)
    _, similarity = structural_similarity(  # type: ignore[misc]
        render,
        truth,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=_LEVELS,
        channel_axis=2,
        full=True,
    )
    inside = np.s_[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]
    figures = {}
    for region, mask in masks.items():
        with np.errstate(divide="ignore"):  # equal pictures: infinite
            figures[column("psnr", region)] = float(-10.0 * np.log10(_weighted(error, mask)))
        figures[column("ssim", region)] = _weighted(similarity.mean(axis=2)[inside], mask[inside])
    return figures


def _weighted(values: Float[np.ndarray, "H W"], weights: Float[np.ndarray, "H W"]) -> float:
    return float(np.average(values, weights=weights)) if weights.any() else math.nan


def _mask(folder: Path, region: str, index: int, shape: tuple[int, ...]) -> Float[np.ndarray, "H W"]:
    """Nothing where the head model does not show the region and no masks of it were written."""
    masks = folder / MASK_FOLDERS[region]
    return _read(masks / f"{index:05d}.png") if masks.is_dir() else np.zeros(shape)


def _read(path: Path) -> Float[np.ndarray, "H W ..."]:
    data = _again(lambda: read_bytes(path, MAX_BYTES))
    try:
        return imread(io.BytesIO(data)).astype(np.float64)
    except (OSError, ValueError, SyntaxError) as error:
        raise UserError(f"{path} cannot be read ({error}); evaluate again with --verify") from None


def _again(read: Callable[[], Any]) -> Any:
    try:
        return read()
    except UserError as error:
        raise UserError(f"{error}; evaluate again with --verify") from None


def _mean(values: Sequence[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return math.fsum(finite) / len(finite) if finite else math.nan
