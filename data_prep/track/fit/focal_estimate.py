"""The focal length from a clip in which the head turns: a near camera shows it in stronger perspective.

Landmarks do not tell it, since their errors depend on the view: their residual falls with the focal length on every clip.
The pictures do, see `turning_skin`. The estimate is taken where it depends little on how much the identity may differ from
the mean: that prior decides where the pictures do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int

from avatar.head.assets import HeadAssets
from data_prep.track.faces.embedding import LandmarkEmbedding
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.chunks import side_by_side
from data_prep.track.fit.crops import BlurredCrops, Crops, cut_out
from data_prep.track.fit.landmark_fit import CLIP_WORTH, POINT_SHARE, LandmarkFit, fit_landmarks, rigid_poses
from data_prep.track.fit.photometric_fit import EYES_IN_CROPS, boxes_of
from data_prep.track.fit.result import Clip
from data_prep.track.fit.skin_points import skin_triangles, spread_points
from data_prep.track.fit.surface import SurfacePoints
from data_prep.track.fit.turning_skin import Adjusted, TurningSkin

FRAMES = 48
# Degrees, 5 to 95 % of the frames. Errors of demo people who turn by 67 to 83 degrees: up to 13 %; by about 45: 19 %; by
# 21 to 26: 50 %.
LEAST_TURNS = 60.0
BLURS = (6.0, 3.0, 1.5)  # per cent of the distance between the eyes
STEPS = (3, 3, 6)  # for each blur
ROUNDS = 2  # landmark fits, each with the focal length that the one before came to
OTHER_STARTS = (1 / 1.4, 1.4)  # of what was found: where the clip does not tell, the estimate stays where it starts
OTHER_WEIGHTS = (0.2, 5.0)  # of the identity's prior, to see how much it decides
MOST_UNCERTAINTY = 0.15
LEAST_UNCERTAINTY = 0.10  # errors on demo people where the prior decides nothing
FARTHEST = 4.0  # times the assumed focal length, or one of so many parts of it
UNSEEN = "the pictures show too little of the face"
_BOX_POINTS = 300


class NotTold(Exception):
    """The clip does not tell its focal length; the message says why."""


def estimate_focal(assets: HeadAssets, embedding: LandmarkEmbedding, clip: Clip) -> tuple[float, float]:
    """The clip's focal length in those of `clip.intrinsics`, and its relative uncertainty. Raises NotTold."""
    camera, detected = Pinhole(*clip.intrinsics), np.flatnonzero(clip.landmarks.detected)
    with side_by_side():
        R = rigid_poses(assets, embedding, clip.landmarks.points[detected], camera)[0].numpy()
        angles = yaw_and_pitch(R)
        turns = float(np.subtract(*np.percentile(angles[:, 0], [95, 5])))
        if turns < LEAST_TURNS:
            raise NotTold(f"the head turns by {turns:.0f} degrees, and {LEAST_TURNS:.0f} are needed")
        numbers = detected[different(angles, FRAMES)]
        chosen = np.zeros_like(clip.landmarks.detected)
        chosen[numbers] = True
        try:
            return _estimate(assets, embedding, replace(clip, landmarks=replace(clip.landmarks, detected=chosen)))
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            raise NotTold(UNSEEN) from None


def yaw_and_pitch(R: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T 2"]:
    """Degrees."""
    forward = R[:, :, 2]  # the face looks along its own z
    yaw = np.arctan2(forward[:, 0], -forward[:, 2])
    return np.degrees(np.stack((yaw, np.arcsin(forward[:, 1].clip(-1, 1))), axis=1))


def different(angles: Float[np.ndarray, "T 2"], count: int) -> Int[np.ndarray, " K"]:
    """Rows that differ most: the middle one, then always the one that is farthest from those already chosen."""
    chosen = [int(np.linalg.norm(angles - np.median(angles, axis=0), axis=1).argmin())]
    distance = np.linalg.norm(angles - angles[chosen[0]], axis=1)
    while len(chosen) < min(count, len(angles)):
        distance[chosen] = -1.0
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(angles - angles[chosen[-1]], axis=1))
    return np.sort(chosen)


def _estimate(assets: HeadAssets, embedding: LandmarkEmbedding, clip: Clip) -> tuple[float, float]:
    assumed = camera = Pinhole(*clip.intrinsics)
    weight = int(clip.landmarks.detected.sum()) / CLIP_WORTH

    def fitted(at: Pinhole) -> LandmarkFit:
        return fit_landmarks(assets, assets.names, embedding, clip.landmarks, at)

    first = fitted(camera)
    crops, levels = _crops(assets, first, camera, clip)

    def improved(fit: LandmarkFit, at: Pinhole) -> tuple[TurningSkin, Adjusted]:
        skin = TurningSkin(assets, fit, at, crops)
        return skin, _adjusted(skin, skin.start, levels, STEPS, weight)

    def from_another(start: float) -> Pinhole:
        at = camera._replace(fx=camera.fx * start, fy=camera.fy * start)
        return improved(fitted(at), at)[1].camera

    skin, done = improved(first, camera)
    for _ in range(ROUNDS - 1):
        camera = _plausible(done.camera, assumed)
        skin, done = improved(fitted(camera), camera)
    camera = _plausible(done.camera, assumed)
    others = [_adjusted(skin, done, levels[-1:], STEPS[-1:], weight * share).camera for share in OTHER_WEIGHTS]
    others += map(from_another, OTHER_STARTS)
    change = max(abs(float(np.log(max(other.fx, 1e-9) / camera.fx))) for other in others)
    if not change <= MOST_UNCERTAINTY:
        raise NotTold(
            f"the estimate changes by {100 * change:.0f} % with where it starts and with the identity's prior"
        )
    return camera.fx / assumed.fx, max(LEAST_UNCERTAINTY, change)


def _crops(assets: HeadAssets, fit: LandmarkFit, camera: Pinhole, clip: Clip) -> tuple[Crops, list[BlurredCrops]]:
    eyes = float(fit.term.unit.mean()) / POINT_SHARE  # pixels of the frames
    corners, barycentric = spread_points(assets, skin_triangles(assets), _BOX_POINTS)
    points = SurfacePoints(assets, corners, barycentric, len(fit.identity), fit.expressions)
    boxes = boxes_of(points, fit.identity, fit.motion, camera)
    crops = cut_out(clip.images, clip.mattes, fit.frames.tolist(), boxes, min(1.0, EYES_IN_CROPS / eyes))
    return crops, [BlurredCrops(crops, 0.01 * blur * eyes * crops.scale) for blur in BLURS]


def _adjusted(
    skin: TurningSkin, at: Adjusted, levels: Sequence[BlurredCrops], steps: Sequence[int], weight: float
) -> Adjusted:
    for images, count in zip(levels, steps, strict=True):
        weights = skin.weights(at)
        if not weights.any():
            raise NotTold(UNSEEN)
        for _ in range(count):
            at = skin.step(at, images, weights, weight)
            if not (at.t[:, 2] > 0).all():  # not a number is not in front of the camera either
                raise NotTold(UNSEEN)
    return at


def _plausible(found: Pinhole, assumed: Pinhole) -> Pinhole:
    if not 1 / FARTHEST < found.fx / assumed.fx < FARTHEST:  # not a number is not between either
        raise NotTold(f"the estimate is {found.fx / assumed.fx:.2g} times the assumed one")
    return found
