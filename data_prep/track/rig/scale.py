"""The scale of a rig's world and the head's distance at each time, from face landmarks in several cameras.

One camera cannot tell size from distance. Its tracking gives the landmarks' points X_n at time n in the front camera's
axes; a calibration gives each camera's R, t from there, in a unit of its own. The fit looks for one factor s, and for a
depth d_n along the direction x_n from the front camera to the head, so that R_c (X_n + d_n x_n) + s t_c is projected onto
what was found in camera c. Gauss-Newton steps with weights of Cauchy's loss; the depths are eliminated before s is solved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from avatar.errors import UserError
from data_prep.formats.frame_track import FrameTrack

_STEPS = 30
_FACING = 0.35  # cosine between a point's normal and the direction to a camera: with less it is hidden or guessed
_OUTLIER = 2.0  # medians of the errors, at which the square of one counts half
_ODD = 3.0  # times the median camera's error: a camera with more is left out
MAX_ERROR = 0.03  # of the face's height: the median error above which the calibration is called wrong
_NEAREST = 1e-3  # metres before a camera


class View(NamedTuple):
    """One camera from the front camera's axes, and what was found in its pictures."""

    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, 3]  # in the calibration's unit
    intrinsics: Float[np.ndarray, 4]  # fx, fy, cx, cy in pixels
    found: Float[np.ndarray, "T L 2"]  # pixels; NaN where no face was found


class Points(NamedTuple):
    """Of the landmarks on the tracked head, in the front camera's axes."""

    positions: Float[np.ndarray, "T L 3"]  # metres
    normals: Float[np.ndarray, "T L 3"]


class Placement(NamedTuple):
    scale: float  # metres for one unit of the calibration
    shifts: Float[np.ndarray, "T 3"]  # of the head, metres in the front camera's axes
    before: float  # pixels between projected and found landmarks, as tracked and calibrated: the median camera's median
    after: float
    cameras: tuple[str, ...]  # that were used

    def moved(self, row: int, track: FrameTrack) -> FrameTrack:
        """The head before the front camera at one time."""
        return replace(track, t=track.t + self.shifts[row])


def place_head(points: Points, views: Mapping[str, View]) -> Placement:
    """Raises UserError for fewer than two cameras with faces, and for cameras that do not look at one head."""
    seen = {name: view for name, view in views.items() if np.isfinite(view.found).any()}
    if len(seen) < 2:
        raise UserError(
            f"a face was found in {len(seen)} of {len(views)} cameras; two at least are needed to tell its size from its "
            "distance: give cameras that see it from the front"
        )
    start = Placement(1.0, np.zeros((len(points.positions), 3)), 0.0, 0.0, ())
    before, start = _median(_errors(points, seen, start)), start._replace(scale=_first_scale(points, seen))
    fit = _fitted(points, seen, start)
    errors = _errors(points, seen, fit)
    kept = {name: seen[name] for name, error in errors.items() if error <= _ODD * _median(errors)}
    if 2 <= len(kept) < len(seen):
        fit = _fitted(points, kept, start)
    return fit._replace(before=before, after=_median(_errors(points, seen, fit)), cameras=tuple(kept))


def refuse_misfit(placed: Placement, views: Mapping[str, View], folder: Path) -> None:
    """Raises UserError where the landmarks do not agree after the fit."""
    heights = [np.nanmedian(np.ptp(views[name].found[..., 1], axis=1)) for name in placed.cameras]
    if not placed.after <= MAX_ERROR * np.median(heights):
        raise UserError(
            f"the calibration of {folder} does not fit the pictures: landmarks of the face are off by {placed.after:.1f} "
            f"pixels in the median, which is more than {MAX_ERROR:.0%} of the face's height ({np.median(heights):.0f} "
            "pixels); give the calibration of these videos"
        )


def _first_scale(points: Points, views: Mapping[str, View]) -> float:
    """The median of the scales at which each picture's ray through the face passes the head.

    Raises UserError where it is not positive: then the cameras look elsewhere.
    """
    X, scales = points.positions.mean(1), [np.zeros(0)]
    for view in views.values():
        fx, fy, cx, cy = view.intrinsics
        x, y = view.found.mean(1).T  # not finite where there is no face
        ray = np.stack(((x - cx) / fx, (y - cy) / fy, np.ones_like(x)), axis=-1)
        across, moved = np.cross(ray, view.t), np.cross(ray, X @ view.R.T)
        if view.t.any():
            scales.append(-(across * moved).sum(1) / np.maximum((across**2).sum(1), 1e-300))
    every = np.concatenate(scales)
    scale = float(np.median(every[np.isfinite(every)])) if np.isfinite(every).any() else 0.0
    if not 1e-6 < scale < 1e6:
        raise UserError(
            "the calibration does not fit the pictures: by it, the cameras do not look at the face that they show; give "
            "the calibration of these videos"
        )
    return scale


def _fitted(points: Points, views: Mapping[str, View], fit: Placement) -> Placement:
    way = points.positions.mean(1)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    for _ in range(_STEPS):
        A, B, g, S, h = np.full(len(way), 1e-9), 0.0, 0.0, 0.0, 0.0
        usual = float(np.clip(_OUTLIER * _median(_errors(points, views, fit)), 1e-9, 1e9))
        for view in views.values():
            at, off, is_used = _projected(points, view, fit)
            weights = is_used / (1.0 + (off**2).sum(-1) / usual**2)
            by_depth = _slope(view, at, (way @ view.R.T)[:, None])
            by_scale = _slope(view, at, view.t)
            A, B = A + _sum(weights, by_depth, by_depth), B + _sum(weights, by_depth, by_scale)
            g, S = g + _sum(weights, by_depth, off), S + _sum(weights, by_scale, by_scale).sum()
            h += _sum(weights, by_scale, off).sum()
        step = -(h - (B * g / A).sum()) / max(S - (B * B / A).sum(), 1e-12)
        shifts = fit.shifts - ((g + B * step) / A)[:, None] * way
        fit = fit._replace(scale=fit.scale + step, shifts=shifts)
    return fit


def _sum(weights: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[T]: over a time's landmarks."""
    return (weights[..., None] * a * b).sum((1, 2))


def _slope(view: View, at: Float[np.ndarray, "T L 3"], along: np.ndarray) -> Float[np.ndarray, "T L 2"]:
    """How pixels change where points of the camera's axes move along a direction."""
    z = np.maximum(at[..., 2:], _NEAREST)
    return view.intrinsics[:2] * (along[..., :2] - at[..., :2] / z * along[..., 2:]) / z


def _projected(points: Points, view: View, fit: Placement) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In the camera's axes [T, L, 3], the errors in pixels [T, L, 2], and which points are seen [T, L]."""
    at = (points.positions + fit.shifts[:, None]) @ view.R.T + fit.scale * view.t
    z = np.maximum(at[..., 2:], _NEAREST)
    off = view.intrinsics[:2] * at[..., :2] / z + view.intrinsics[2:] - view.found
    facing = -(points.normals @ view.R.T * at).sum(-1) / np.linalg.norm(at, axis=-1)
    is_used = np.isfinite(off).all(-1) & (facing > _FACING) & (at[..., 2] > _NEAREST)
    return at, np.where(is_used[..., None], off, 0.0), is_used


def _errors(points: Points, views: Mapping[str, View], fit: Placement) -> dict[str, float]:
    """Each camera's median distance in pixels; infinite where nothing can be compared."""
    errors = {}
    for name, view in views.items():
        _, off, is_used = _projected(points, view, fit)
        errors[name] = float(np.median(np.linalg.norm(off, axis=-1)[is_used])) if is_used.any() else np.inf
    return errors


def _median(errors: Mapping[str, float]) -> float:
    return float(np.median([*errors.values()]))
