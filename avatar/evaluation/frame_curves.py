"""The figures of an evaluation along the video, as a picture."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import numpy as np

from avatar.errors import check_installed
from avatar.evaluation.protocol import REGIONS, Protocol, column
from avatar.evaluation.results import FrameResult
from avatar.evaluation.tracking_source import Drive


def curves(
    protocols: Sequence[Protocol],
    by_drive: Mapping[Drive, Mapping[str, Sequence[FrameResult]]],
    shown: str,
    worst: Sequence[int],
) -> bytes:
    """A PNG file: main PSNR and SSIM of each protocol, PSNR by region, jitter and conditions against the frame's index.

    All of the tracker's tracking, which is first in `by_drive`; beside it a dashed PSNR of the refined one.
    worst  indices of the worst frames by the protocol `shown`, marked on its PSNR.
    Raises MissingPackage without matplotlib.
    """
    check_installed("curves.png", "plots", "matplotlib")
    results, *refined = by_drive.values()
    from matplotlib.figure import Figure  # takes half a second

    figure = Figure(figsize=(12, 12), layout="constrained")
    by_psnr, by_ssim, by_region, by_jitter, by_condition = figure.subplots(5, 1, sharex=True)
    for number, protocol in enumerate(protocols):
        width = 1.0 + 0.6 * (len(protocols) - 1 - number)  # a line that lies on an earlier one leaves its rim
        for axes, name in ((by_psnr, "psnr"), (by_ssim, "ssim"), (by_jitter, "jitter")):
            axes.plot(*line(results[protocol.name], name), lw=width, label=protocol.name)
    detailed = max(protocols, key=lambda protocol: len(protocol.regions))
    marked = [result for result in results[shown] if result.index in worst]
    by_psnr.plot(
        [result.index for result in marked],
        [result.figures["psnr"] for result in marked],
        "kv",
        ms=5,
        label=f"worst of {shown}",
    )
    for fitted in refined:
        label = f"{shown}, refined:\nfitted to these frames"
        by_psnr.plot(*line(fitted[shown], "psnr"), "k--", lw=0.8, label=label)
        by_psnr.set_title("driven by the tracker's tracking", fontsize=10)
    for region in (region for region in REGIONS if region in detailed.regions):
        by_region.plot(*line(results[detailed.name], column("psnr", region)), lw=1, label=region)
    longest = max((results[protocol.name] for protocol in protocols), key=len)
    indices = [result.index for result in longest]
    by_condition.plot(indices, [result.conditions.yaw for result in longest], lw=1, color="C0")
    distance = by_condition.twinx()
    distance.plot(indices, [result.conditions.expression_distance for result in longest], lw=1, color="C1")
    distance.set_ylabel("expression distance, mm", color="C1")
    by_condition.set_ylabel("yaw, degrees", color="C0")
    by_psnr.set_ylabel("PSNR, dB")
    by_ssim.set_ylabel("SSIM")
    by_region.set_ylabel(f"PSNR of regions, dB\n({detailed.name})")
    by_jitter.set_ylabel("jitter, levels")
    by_condition.set_xlabel("frame")
    for axes in (by_psnr, by_ssim, by_region, by_jitter, by_condition):
        axes.grid(alpha=0.3)
    for axes in (by_psnr, by_ssim, by_region, by_jitter):
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=90)
    return file.getvalue()


def line(results: Sequence[FrameResult], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Indices and values, with a NaN in every gap between indices, so that no line crosses it."""
    x = np.array([result.index for result in results], dtype=float)
    y = np.array([result.figures[name] for result in results])
    gaps = np.flatnonzero(np.diff(x) > 1) + 1
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)
