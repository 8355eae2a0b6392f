"""What results.json says of one protocol: its choices and the figures in short."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from avatar.evaluation.bootstrap import BlockBootstrap, block_length, describe
from avatar.evaluation.find_lpips import ChosenLpips
from avatar.evaluation.held_out import View
from avatar.evaluation.measure import Figures
from avatar.evaluation.protocol import Protocol
from avatar.evaluation.tracking_source import Drive
from avatar.evaluation.training_coverage import Conditions

YAW_EDGES = (-30.0, -10.0, 10.0, 30.0)  # degrees
DISTANCE_QUANTILES = (0.25, 0.5, 0.75)  # edges of the bins of expression distance: four bins with as many frames each
WORST = 8


class FrameResult(NamedTuple):
    index: int
    name: str
    figures: Figures
    conditions: Conditions


def summarise(
    protocol: Protocol,
    results: Mapping[Drive, Sequence[FrameResult]],
    lpips: ChosenLpips,
    fps: float,
    seen: Mapping[int, View] | None = None,
) -> dict[str, Any]:
    """One protocol's entry of results.json, which `parts` reads; `results` are in the order of `drives`.

    seen  what each frame is of, with several cameras
    """
    *before, own = results
    frames = [result.name for result in results[own]]
    at_once = len(frames) / max(1, len({seen[result.index].time for result in results[own]})) if seen else 1
    block = block_length(len(frames), fps * at_once)
    return {
        "choices": protocol.choices(),
        "lpips": lpips.as_json(),
        "bootstrap": describe(block),
        "frames": frames,
        **{drive: _figures(protocol, results[drive], block, seen) for drive in before},
        "driven_by": own,
        **_figures(protocol, results[own], block, seen),
    }


def _figures(
    protocol: Protocol, results: Sequence[FrameResult], block: int, seen: Mapping[int, View] | None
) -> dict[str, Any]:
    """Means are over the frames that have a finite figure; blocks are of frames in the order of time."""
    of = [seen[result.index] for result in results] if seen else []
    order = sorted(range(len(results)), key=lambda row: of[row].time if of else row)
    groups = {
        "by_held_out": [view.held_out for view in of],
        "by_camera": [f"{view.camera}, {view.held_out}" for view in of],
    }
    figures = {name: np.array([result.figures[name] for result in results]) for name in protocol.columns}
    bootstrap = BlockBootstrap(len(results), block)
    yaws = np.array([result.conditions.yaw for result in results])
    distances = np.array([result.conditions.expression_distance for result in results])
    return {
        "means": means(figures),
        "intervals": {name: bootstrap.interval(values[order]) for name, values in figures.items()},
        "frames_with_a_figure": {name: int(np.isfinite(values).sum()) for name, values in figures.items()},
        "by_yaw": binned(yaws, YAW_EDGES, figures),
        "by_expression_distance": binned(distances, np.quantile(distances, DISTANCE_QUANTILES), figures),
        **({name: grouped(keys, figures) for name, keys in groups.items()} if of else {}),
        "worst": [
            {"frame": result.index, "name": result.name, "psnr": result.figures["psnr"]}
            for result in worst_frames(results)
        ],
    }


def means(figures: Mapping[str, np.ndarray]) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for name, values in figures.items():
        finite = values[np.isfinite(values)].tolist()
        found[name] = math.fsum(finite) / len(finite) if finite else None
    return found


def binned(
    values: np.ndarray, edges: Sequence[float] | np.ndarray, figures: Mapping[str, np.ndarray]
) -> list[dict[str, Any]]:
    """Means of the figures over the frames in each bin [from, to) that has any; None: the bin is open on that side."""
    bins = np.digitize(values, edges)
    bounds = [None, *(float(edge) for edge in edges), None]
    return [
        {
            "from": bounds[number],
            "to": bounds[number + 1],
            "frames": int((bins == number).sum()),
            "means": means({name: column[bins == number] for name, column in figures.items()}),
        }
        for number in np.unique(bins).tolist()
    ]


def grouped(keys: Sequence[str], figures: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Means of the figures over the frames of each key."""
    found = []
    for key in sorted(set(keys)):
        own = np.array([one == key for one in keys])
        own_means = means({name: values[own] for name, values in figures.items()})
        found.append({"name": key, "frames": int(own.sum()), "means": own_means})
    return found


def worst_frames(results: Sequence[FrameResult]) -> list[FrameResult]:
    """Up to `WORST` frames of lowest main PSNR, worst first."""
    finite = [result for result in results if math.isfinite(result.figures["psnr"])]
    return sorted(finite, key=lambda result: result.figures["psnr"])[:WORST]
