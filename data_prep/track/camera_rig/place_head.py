"""The scale of a rig's world, and the head's distance and turn, from face landmarks in several cameras.

One camera cannot tell size from distance, and hardly a turn from another face. Its tracking gives, in the front camera's
axes, each time's turn R_n and the landmarks' points X_n with their mean x_n; a calibration gives each camera's R, t from
there, in a unit of its own. The fit looks for a scale s and a turn W in the head's axes, one for the clip, and for a depth
d_n along the direction e_n of x_n, so that R_c (R_n W R_n^T (X_n - x_n) + x_n + d_n e_n) + s t_c is projected onto what was
found in camera c. Gauss-Newton steps with weights of Cauchy's loss; the depths are eliminated before the others are solved
for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from avatar.errors import UserError
from data_prep.formats.frame_track import FrameTrack

_STEPS = 30
_FACING = 0.35  # cosine between a point's normal and the direction to a camera: with less it is hidden or guessed
_OUTLIER = 2.0  # medians of the errors, at which the square of one counts half
_ODD = 3.0  # times the median camera's error: a camera with more is left out,
_FINE = 1.0  # pixels, if that is more than this
MAX_ERROR = 0.03  # of the face's height: the median error above which the calibration is called wrong
_NEAREST = 1e-3  # metres before a camera
_SAME_PLACE = 0.02  # of the head's distance: a camera so close to the front one says nothing of the scale


class View(NamedTuple):
    """One camera from the front camera's axes, and what was found in its pictures."""

    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, " 3"]  # in the calibration's unit
    intrinsics: Float[np.ndarray, " 4"]  # fx, fy, cx, cy in pixels
    found: Float[np.ndarray, "T L 2"]  # pixels; NaN where no face was found


class Points(NamedTuple):
    """Of the landmarks on the tracked head, in its own axes, and its pose before the front camera."""

    positions: Float[np.ndarray, "T L 3"]  # metres, from their mean
    normals: Float[np.ndarray, "T L 3"]
    turns: Float[np.ndarray, "T 3 3"]
    centres: Float[np.ndarray, "T 3"]  # metres


class Placement(NamedTuple):
    scale: float  # metres for one unit of the calibration
    turn: Float[np.ndarray, "3 3"]  # of the head in its own axes
    shifts: Float[np.ndarray, "T 3"]  # of the head, metres in the front camera's axes
    before: float  # pixels between projected and found landmarks, as tracked and calibrated: the median camera's median
    after: float
    cameras: tuple[str, ...]  # that were used

    def moved(self, row: int, track: FrameTrack, centre: Float[np.ndarray, " 3"]) -> FrameTrack:
        """The head before the front camera at one time; it turns about `centre`, the landmarks' mean."""
        R = track.R @ self.turn
        return replace(track, R=R, t=centre + R @ track.R.T @ (track.t - centre) + self.shifts[row])


def place_head(points: Points, views: Mapping[str, View]) -> Placement:
    """Raises UserError for fewer than two cameras with faces, and for cameras that do not look at one head."""
    seen = {name: view for name, view in views.items() if np.isfinite(view.found).any()}
    if len(seen) < 2:
        raise UserError(
            f"a face was found in {len(seen)} of {len(views)} cameras; two at least are needed to tell its size from its "
            "distance: give cameras that see it from the front"
        )
    start = Placement(1.0, np.eye(3), np.zeros_like(points.centres), 0.0, 0.0, ())
    before = _median(_errors(points, seen, start))
    unit = max(float(np.linalg.norm(view.t)) for view in seen.values()) or 1.0  # so that steps are of one size
    seen = {name: view._replace(t=view.t / unit) for name, view in seen.items()}
    fit = _fitted(points, seen, start)
    errors = _errors(points, seen, fit)
    kept = {name: seen[name] for name, error in errors.items() if error <= max(_ODD * _median(errors), _FINE)}
    if 2 <= len(kept) < len(seen):
        fit = _fitted(points, kept, start)
    after = _median(_errors(points, seen, fit))
    return fit._replace(scale=fit.scale / unit, before=before, after=after, cameras=tuple(kept))


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

    Raises UserError where cameras stand at one place, and where it is not positive: then they look elsewhere.
    """
    scales, near = [np.zeros(0)], _SAME_PLACE * np.linalg.norm(points.centres, axis=1)
    for view in views.values():
        fx, fy, cx, cy = view.intrinsics
        x, y = view.found.mean(1).T  # not finite where there is no face
        ray = np.stack(((x - cx) / fx, (y - cy) / fy, np.ones_like(x)), axis=-1)
        across, moved = np.cross(ray, view.t), np.cross(ray, points.centres @ view.R.T)
        own = -(across * moved).sum(1) / np.maximum((across**2).sum(1), 1e-300)
        scales.append(own[np.abs(own) * np.linalg.norm(view.t) > near])
    every = np.concatenate(scales)
    if not len(every):
        raise UserError(
            "the cameras that see the face stand at one place, which does not tell its size from its distance; give one "
            "that sees it from aside"
        )
    scale = float(np.median(every))
    if not 0 < scale < np.inf:
        raise UserError(
            "the calibration does not fit the pictures: by it, the cameras do not look at the face that they show; give "
            "the calibration of these videos"
        )
    return scale


def _fitted(points: Points, views: Mapping[str, View], fit: Placement) -> Placement:
    fit = fit._replace(scale=_first_scale(points, views))
    way = points.centres / np.linalg.norm(points.centres, axis=1, keepdims=True)
    for _ in range(_STEPS):
        H, g = np.zeros((len(way), 5, 5)), np.zeros((len(way), 5))  # depth, scale, turn
        usual = float(np.clip(_OUTLIER * _median(_errors(points, views, fit)), 1e-9, 1e9))
        arms = points.positions @ fit.turn.T
        for view in views.values():
            at, off, is_used = _projected(points, view, fit)
            root = np.sqrt(is_used / (1.0 + (off**2).sum(-1) / usual**2))[..., None]
            turned = (np.cross(axis, arms) @ points.turns.transpose(0, 2, 1) @ view.R.T for axis in np.eye(3))
            along = ((way @ view.R.T)[:, None], view.t, *turned)
            J = np.stack([_slope(view, at, each) * root for each in along], axis=-1)
            H += np.einsum("tlqi,tlqj->tij", J, J)
            g += np.einsum("tlqi,tlq->ti", J, off * root)
        by_depth = H[:, 0, 1:] / np.maximum(H[:, 0, :1], 1e-9)
        common = (H[:, 1:, 1:] - by_depth[:, :, None] * H[:, :1, 1:]).sum(0)
        step = np.linalg.lstsq(common, -(g[:, 1:] - by_depth * g[:, :1]).sum(0), rcond=1e-9)[0]
        depths = -g[:, 0] / np.maximum(H[:, 0, 0], 1e-9) - by_depth @ step
        turn = cv2.Rodrigues(step[1:])[0] @ fit.turn
        fit = fit._replace(scale=float(fit.scale + step[0]), turn=turn, shifts=fit.shifts + depths[:, None] * way)
    return fit


def _slope(view: View, at: Float[np.ndarray, "T L 3"], along: np.ndarray) -> Float[np.ndarray, "T L 2"]:
    """How pixels change where points of the camera's axes move along a direction."""
    z = np.maximum(at[..., 2:], _NEAREST)
    return view.intrinsics[:2] * (along[..., :2] - at[..., :2] / z * along[..., 2:]) / z


def _projected(points: Points, view: View, fit: Placement) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In the camera's axes [T, L, 3], the errors in pixels [T, L, 2], and which points are seen [T, L]."""
    turns = (view.R @ points.turns @ fit.turn).transpose(0, 2, 1)
    at = points.positions @ turns + ((points.centres + fit.shifts) @ view.R.T)[:, None] + fit.scale * view.t
    z = np.maximum(at[..., 2:], _NEAREST)
    off = view.intrinsics[:2] * at[..., :2] / z + view.intrinsics[2:] - view.found
    facing = -(points.normals @ turns * at).sum(-1) / np.linalg.norm(at, axis=-1)
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
