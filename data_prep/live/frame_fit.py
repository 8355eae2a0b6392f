"""The tracker's fit one frame at a time: the identity is known, the frames before are done, the ones after are not there.

What is minimised is what `landmark_fit` minimises, without what lies ahead: landmarks, priors, and smoothness towards the
two frames before. A few steps from the last frame do, because it is near. `scripts/measure_webcam.py` says how far from the
fit of a whole clip it stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from data_prep.track.faces.detect import Face
from data_prep.track.faces.embedding import LandmarkEmbedding
from data_prep.track.faces.landmarks import Landmarks
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.expression_kind import is_statistical
from data_prep.track.fit.frame_poses import Motion, at_rest
from data_prep.track.fit.initial_pose import start_poses
from data_prep.track.fit.landmark_fit import LandmarkFit, faded, is_rigid, point_units, weighted_landmarks
from data_prep.track.fit.levenberg_marquardt import Term, concatenated, minimise
from data_prep.track.fit.normal_equations import NormalEquations
from data_prep.track.fit.priors import both_ways, expected, score_targets
from data_prep.track.fit.smoothness import NOMINAL_FPS, Smoothness, make_smoothness

STEPS = 2  # of Levenberg-Marquardt; more do not bring it nearer to the fit of the whole clip
FIRST_STEPS = 8  # of a face that nothing is known of
QUICKEST = 10.0  # m/s^2 across the picture: what is quicker is a cut, or is torn in half by the smoothness
LEAST_QUICK = 0.01  # metres, that are not called quick in any time
LOST_AFTER = 0.5  # seconds after which a face is looked for anew
POSE_LOOSER = 0.5  # times the stiffness of a clip's fit: without later frames what is stiff lags behind
FASTEST, SLOWEST = 60.0, 5.0  # frames a second that the smoothness is scaled to
_BEHIND = 1e-3  # metres; a head nearer than this is not in front of the camera


@dataclass(frozen=True)
class _Fitted:
    """A frame that is done."""

    motion: Motion
    taken: float  # seconds


class FrameFit:
    """Frames in the order of their times; `fit` is the calibration's, whose identity is kept."""

    def __init__(
        self,
        assets: HeadAssets,
        embedding: LandmarkEmbedding,
        fit: LandmarkFit,
        camera: Pinhole,
        size: tuple[int, int],
    ) -> None:
        self._assets, self._fit, self._camera, self._size = assets, fit, camera, size
        self._targets = score_targets(assets.names, fit.expressions)
        self._priors = both_ways(fit.priors, self._targets)  # the calibration's faces were calm
        _, self._weights = weighted_landmarks(assets, embedding)
        self._rigid = is_rigid(fit.term.landmarks)
        self._smoothness = make_smoothness(
            assets, torch.arange(3), NOMINAL_FPS, len(fit.expressions), is_statistical(assets)
        )
        self._before: list[_Fitted] = []  # at most two

    def next(self, face: Face, taken: float) -> Motion | None:
        """The motion [T = 1] of the face in the picture that was taken at this time in seconds, after those before.

        None where the fit goes astray; the next one starts anew.
        """
        if self._before and not 0 < taken - self._before[-1].taken < LOST_AFTER:
            self._before = []
        seen = Landmarks(face.points[None], face.scores[None], np.ones(1, bool), self._size, NOMINAL_FPS)
        try:
            start = self._start(seen)
        except (cv2.error, UserError):  # points that no camera sees so
            self._before = []
            return None
        term = replace(
            self._fit.term,
            observed=torch.from_numpy(seen.points[:, self._fit.term.landmarks, :2].astype(np.float64)),
            weights=faded(self._weights, self._fit.term.landmarks, seen),
            unit=point_units(self._assets, self._camera, start.t),
            pair_weights=self._fit.term.pair_weights[:1],
        )
        priors = replace(self._priors, mean=expected(seen, self._targets, len(self._fit.expressions)))
        terms: list[Term] = [term, priors]
        steps = STEPS if self._before else FIRST_STEPS
        if _is_quick(self._before, start, taken):
            self._before = []
        if self._before:
            terms.append(_follows(self._smoothness, self._before, taken))
        done = minimise(terms, self._fit.identity, start, steps)
        if not (torch.isfinite(done.motion.coefficients()).all() and done.motion.t[0, 2] > _BEHIND):
            self._before = []
            return None
        self._before = [*self._before[-1:], _Fitted(done.motion, taken)]
        return done.motion

    def _start(self, seen: Landmarks) -> Motion:
        """The last frame's face, moved as a whole to where the landmarks are now; the generic one where there is none."""
        term, E = self._fit.term, len(self._fit.expressions)
        pixels = seen.points[:, term.landmarks[self._rigid], :2]
        last = self._before[-1].motion if self._before else None
        at = at_rest(*_ahead(), E) if last is None else last
        points = term.points.positions(self._fit.identity, at)[0, self._rigid].numpy()
        if last is None:
            return replace(at, **dict(zip(("R", "t"), start_poses(points, pixels, self._camera), strict=True)))
        R, t = _moved_pose(points, pixels[0], self._camera, last)
        return replace(last, R=R, t=t)


def _ahead() -> tuple[Float[Tensor, "1 3 3"], Float[Tensor, "1 3"]]:
    return torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64)


def _moved_pose(
    points: Float[np.ndarray, "L 3"], pixels: Float[np.ndarray, "L 2"], camera: Pinhole, last: Motion
) -> tuple[Float[Tensor, "1 3 3"], Float[Tensor, "1 3"]]:
    """The pose by Levenberg-Marquardt on the reprojection error from the last one, which stays where that goes astray."""
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    turn, shift = cv2.Rodrigues(last.R[0].numpy())[0], last.t[0].numpy()[:, None].copy()
    turn, shift = cv2.solvePnPRefineLM(
        np.ascontiguousarray(points), np.ascontiguousarray(pixels, np.float64), K, None, turn, shift
    )
    if not (np.isfinite(turn).all() and np.isfinite(shift).all() and shift[2, 0] > _BEHIND):
        return last.R, last.t
    return torch.from_numpy(cv2.Rodrigues(turn)[0])[None], torch.from_numpy(shift[:, 0].copy())[None]


def _is_quick(before: list[_Fitted], start: Motion, taken: float) -> bool:
    """Whether the head has left the place where it would be with the speed that it had."""
    if not before:
        return False
    last, wait = before[-1], taken - before[-1].taken
    expected = last.motion.t[0, :2]
    if len(before) == 2:
        expected = expected + (expected - before[0].motion.t[0, :2]) * wait / (last.taken - before[0].taken)
    return float((start.t[0, :2] - expected).norm()) > max(QUICKEST * wait**2, LEAST_QUICK)


@dataclass(frozen=True)
class _Follows:
    """Smoothness of one frame after those before it, which stay as they are."""

    smoothness: Smoothness
    before: Motion  # one frame or two

    def cost(self, identity: Float[Tensor, " I"], motion: Motion) -> float:
        return self.smoothness.cost(identity, concatenated([self.before, motion]))

    def add_to(self, equations: NormalEquations, identity: Float[Tensor, " I"], motion: Motion) -> None:
        together = concatenated([self.before, motion])
        of_all = NormalEquations.zeros(len(together), equations.gradient.shape[1], 0)
        self.smoothness.add_to(of_all, identity, together)
        equations.diagonal[0] += of_all.diagonal[-1]
        equations.gradient[0] += of_all.gradient[-1]


def _follows(nominal: Smoothness, before: list[_Fitted], taken: float) -> _Follows:
    """At the rate of the last frames, whose distance in time grows where pictures were dropped."""
    rate = len(before) / max(taken - before[0].taken, 1e-3)
    faster = min(max(rate, SLOWEST), FASTEST) / NOMINAL_FPS
    scaled = replace(
        nominal.take(slice(0, len(before) + 1)),
        pose=POSE_LOOSER * nominal.pose * faster**1.5,
        first=nominal.first * faster,
        second=nominal.second * faster**3,
    )
    return _Follows(scaled, concatenated([frame.motion for frame in before]))
