"""A clip's coverage and its course over time, as figures."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from avatar.html import Markup, figure_of, plot
from avatar.html.parts import SERIES
from data_prep.check.check_images import exposure
from data_prep.check.clip import Clip
from data_prep.check.coverage import Coverage

TRAIN, TEST = SERIES[0], SERIES[1]
_FRAME = "image number"


def coverage_plots(coverage: Coverage) -> list[Markup]:
    train, test = list(coverage.split.train), list(coverage.split.test)
    pose, axes = figure_of()
    _scatter(axes, coverage.angles.yaw, coverage.angles.pitch, train, test)
    axes.set(xlabel="yaw in degrees", ylabel="pitch in degrees")
    axes.axis("equal")
    face, axes = figure_of()
    _scatter(axes, coverage.expressions[:, 0], coverage.expressions[:, 1], train, test)
    axes.set(xlabel="first principal expression", ylabel="second principal expression")
    course, axes = figure_of()
    for name, colour in zip(("yaw", "pitch", "roll"), SERIES, strict=False):
        axes.plot(coverage.images, getattr(coverage.angles, name), color=colour, linewidth=1, label=name)
    for first, last in runs(test):
        axes.axvspan(coverage.images[first] - 0.5, coverage.images[last] + 0.5, color=TEST, alpha=0.1, linewidth=0)
    axes.set(xlabel=_FRAME, ylabel="degrees")
    axes.legend(frameon=False, fontsize=8, ncols=3)
    return [
        plot(pose, "Head pose: what the training frames show, and what the held-out frames ask for", "yaw and pitch"),
        plot(face, "Expressions along the two directions in which the training frames vary most", "expressions"),
        plot(course, "Head pose over the clip; shaded: held out", "yaw, pitch and roll over time"),
    ]


def course_plots(clip: Clip) -> list[Markup]:
    """Fit, light and motion over the clip."""
    plots = []
    if clip.fits:
        numbers = list(clip.fits)
        figure, axes = figure_of()
        for name, label, colour in (
            ("overhang", "mesh sticks out of the head mask", SERIES[0]),
            ("mouth", "lips away from the mouth mask", SERIES[1]),
        ):
            values = np.array([getattr(fit, name) for fit in clip.fits.values()])
            if np.isfinite(values).any():
                axes.plot(numbers, values, color=colour, linewidth=1, label=label)
        axes.set(xlabel=_FRAME, ylabel="pixels", ylim=(0, None))
        axes.legend(frameon=False, fontsize=8)
        plots.append(plot(figure, "How the tracked mesh fits the masks", "fit over time"))
    light = exposure(clip)
    if light is not None:
        numbers, head, background = light
        figure, axes = figure_of()
        axes.plot(numbers, head, color=SERIES[0], linewidth=1, label="head")
        if np.isfinite(background).any():
            axes.plot(numbers, background, color=SERIES[2], linewidth=1, label="background")
        low, high = axes.get_ylim()
        axes.set(xlabel=_FRAME, ylabel="stops", ylim=(min(low, -0.3), max(high, 0.3)))
        axes.legend(frameon=False, fontsize=8)
        plots.append(plot(figure, "Brightness against the median of the clip", "brightness over time"))
    if clip.steps:
        figure, axes = figure_of()
        axes.plot(list(clip.steps), list(clip.steps.values()), color=SERIES[0], linewidth=0.8)
        axes.set(xlabel=_FRAME, ylabel="grey levels", ylim=(0, None))
        plots.append(plot(figure, "Mean change of the image since the frame before; zero is a repeat", "image change"))
    return plots


def runs(places: Sequence[int]) -> list[tuple[int, int]]:
    """The first and the last of each row of increasing places that follow each other."""
    ends = [n for n, (place, after) in enumerate(pairwise(places)) if after > place + 1]
    starts = [0, *(n + 1 for n in ends)]
    return [(places[a], places[b]) for a, b in zip(starts, [*ends, len(places) - 1], strict=True)]


def _scatter(axes, x: np.ndarray, y: np.ndarray, train: list[int], test: list[int]) -> None:
    axes.scatter(x[train], y[train], s=7, color=TRAIN, alpha=0.5, linewidths=0, label=f"training ({len(train)})")
    axes.scatter(x[test], y[test], s=9, color=TEST, alpha=0.8, linewidths=0, label=f"held out ({len(test)})")
    axes.legend(frameon=False, fontsize=8)
