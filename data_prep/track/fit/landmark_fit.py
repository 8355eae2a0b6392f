"""The fit of a head model to a clip's landmarks: one identity, and the motion of every frame.

First the identity, from frames spread over the clip and all that moves in them; then the motion of all frames with that
identity, smooth over time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from avatar.head.assets import HeadAssets
from avatar.head.model import LEFT_EYE, RIGHT_EYE
from data_prep.track.faces import landmark_groups as groups
from data_prep.track.faces.embedding import LandmarkEmbedding, as_points, iris_embedding
from data_prep.track.faces.landmarks import Landmarks
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.expression_kind import is_statistical, used_expressions
from data_prep.track.fit.frame_poses import Motion, at_rest
from data_prep.track.fit.initial_pose import start_poses
from data_prep.track.fit.landmark_term import LandmarkTerm
from data_prep.track.fit.levenberg_marquardt import IdentityPrior, minimise
from data_prep.track.fit.priors import Priors, make_priors
from data_prep.track.fit.smoothness import Smoothness, make_smoothness
from data_prep.track.fit.surface import SurfacePoints

POINT_SHARE = 0.02  # of the distance between the eyes: the landmarks' standard deviation
FEATURE_WEIGHTS = {groups.LIPS: 1.3, groups.LIDS: 1.3, groups.BROWS: 0.6, groups.NOSE: 1.0}
OTHER_WEIGHT = 0.12  # of landmarks between the features
OTHER_DISTANCE = 0.16  # in distances between the eyes: nearer than that to lips, lids or brows they are biased
IRIS_WEIGHT = 20.0  # enough that neither the tie between the eyes nor smoothness keeps an iris from its landmark
PAIR_WEIGHT = 2.0
IDENTITIES = 100  # coefficients that are fitted; the others add less than landmarks can tell
# The clip tells as much about the identity as this many independent frames: landmarks err alike in all frames, and near
# each other alike. With 1 the face comes out too deep and nods too small (docs/experiments.csv).
CLIP_WORTH = 0.1
KEY_FRAMES = 120
IDENTITY_ITERATIONS, MOTION_ITERATIONS = 15, 12


@dataclass(frozen=True)
class LandmarkFit:
    identity: Float[Tensor, " I"]
    motion: Motion  # of the frames in `frames`
    frames: Int[Tensor, " T"]  # numbers of the frames with a face
    expressions: Int[Tensor, " E"]  # the head model's coefficients that `motion` holds
    term: LandmarkTerm
    priors: Priors
    smoothness: Smoothness


def fit_landmarks(
    assets: HeadAssets, embedding: LandmarkEmbedding, landmarks: Landmarks, camera: Pinhole
) -> LandmarkFit:
    frames = np.flatnonzero(landmarks.detected)
    seen = Landmarks(
        landmarks.points[frames], landmarks.scores[frames], landmarks.detected[frames], landmarks.size, landmarks.fps
    )
    expressions, statistical = used_expressions(assets), is_statistical(assets)
    identities = min(IDENTITIES, _last_used(assets.shape_dirs) + 1)
    term = make_landmark_term(assets, embedding, seen, camera, identities, expressions)
    R, t = _start(assets, embedding, seen, camera)
    term = replace(term, unit=point_units(assets, camera, t))
    priors = make_priors(seen, assets.names, expressions, statistical)
    smoothness = make_smoothness(assets, torch.from_numpy(frames), landmarks.fps, len(expressions), statistical)
    plausible = priors.mean.clamp(priors.low, priors.high)
    step = torch.cat((torch.zeros(len(R), 6, dtype=torch.float64), plausible), dim=1)
    motion = at_rest(R, t, len(expressions)).moved(step)
    identity = torch.zeros(identities, dtype=torch.float64)
    key = torch.from_numpy(np.unique(np.linspace(0, len(frames) - 1, min(KEY_FRAMES, len(frames))).round().astype(int)))
    first = minimise(
        (term.take(key), priors.take(key), IdentityPrior(len(key) / CLIP_WORTH)),
        identity, motion[key], IDENTITY_ITERATIONS, with_identity=True,
    )  # fmt: skip
    second = minimise((term, priors, smoothness), first.identity, motion, MOTION_ITERATIONS)
    return LandmarkFit(first.identity, second.motion, torch.from_numpy(frames), expressions, term, priors, smoothness)


def make_landmark_term(
    assets: HeadAssets,
    embedding: LandmarkEmbedding,
    seen: Landmarks,
    camera: Pinhole,
    identities: int,
    expressions: Int[Tensor, " E"],
) -> LandmarkTerm:
    """The term of the frames of `seen`; its unit is one pixel as yet."""
    embedding, weights = weighted_landmarks(assets, embedding)
    row = {int(landmark): k for k, landmark in enumerate(embedding.landmarks)}
    pairs = [
        (row[a], row[b])
        for a, b in (*groups.LEFT_LID_PAIRS, *groups.RIGHT_LID_PAIRS, *groups.LIP_PAIRS, groups.MOUTH_WIDTH)
        if a in row and b in row
    ]
    T = len(seen)
    return LandmarkTerm(
        landmarks=embedding.landmarks,
        points=SurfacePoints(assets, *as_points(embedding), identities, expressions),
        camera=camera,
        observed=torch.from_numpy(seen.points[:, embedding.landmarks, :2].astype(np.float64)),
        weights=faded(weights, embedding.landmarks, seen),
        unit=torch.ones(T, dtype=torch.float64),
        pairs=torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2),
        pair_weights=torch.full((T, len(pairs)), PAIR_WEIGHT, dtype=torch.float64),
    )


def weighted_landmarks(
    assets: HeadAssets, embedding: LandmarkEmbedding
) -> tuple[LandmarkEmbedding, Float[Tensor, " L"]]:
    """The landmarks that are fitted to, those of the irises among them, and how much each counts."""
    embedding = embedding.with_others(iris_embedding(assets))
    weight = _landmark_weights(assets, embedding)
    kept = weight > 0
    embedding = LandmarkEmbedding(embedding.landmarks[kept], embedding.corners[kept], embedding.barycentric[kept])
    return embedding, torch.from_numpy(weight[kept])


def faded(weights: Float[Tensor, " L"], landmarks: Int[np.ndarray, " L"], seen: Landmarks) -> Float[Tensor, "T L"]:
    """The weights in each frame of `seen`: an iris counts as far as its eye is open."""
    by_frame = weights.expand(len(seen), -1).clone()
    for iris, open_share in zip(groups.IRISES, seen.open_shares().T, strict=True):
        by_frame[:, landmarks == iris] *= torch.from_numpy(open_share[:, None] ** 2)
    return by_frame


def _landmark_weights(assets: HeadAssets, embedding: LandmarkEmbedding) -> np.ndarray:
    at = (assets.template.numpy()[embedding.corners] * embedding.barycentric[..., None]).sum(1)
    weights = np.full(len(embedding), OTHER_WEIGHT)
    biased = at[np.isin(embedding.landmarks, groups.LIPS + groups.LIDS + groups.BROWS)]
    if len(biased):
        distance = np.linalg.norm(at[:, None] - biased, axis=-1).min(1)
        weights[distance < OTHER_DISTANCE * eye_distance(assets)] = 0.0
    for group, weight in FEATURE_WEIGHTS.items():
        weights[np.isin(embedding.landmarks, group)] = weight
    weights[np.isin(embedding.landmarks, groups.IRISES)] = IRIS_WEIGHT
    return weights


def eye_distance(assets: HeadAssets) -> float:
    """Between the eyes' joints of the template, metres."""
    eyes = (assets.joint_regressor @ assets.template)[[LEFT_EYE, RIGHT_EYE]]
    return float((eyes[0] - eyes[1]).norm())


def _start(assets: HeadAssets, embedding: LandmarkEmbedding, seen: Landmarks, camera: Pinhole) -> tuple[Tensor, Tensor]:
    """Poses by the landmarks of the generic head that the mouth does not move."""
    rigid = is_rigid(embedding.landmarks)
    at = (assets.template.double().numpy()[embedding.corners[rigid]] * embedding.barycentric[rigid, :, None]).sum(1)
    return start_poses(at, seen.points[:, embedding.landmarks[rigid], :2], camera)


def is_rigid(landmarks: Int[np.ndarray, " L"]) -> Bool[np.ndarray, " L"]:
    """Which landmarks tell the head's pose: contours that the mouth does not move."""
    return np.isin(landmarks, groups.FEATURES) & ~np.isin(landmarks, groups.LIPS)


def point_units(assets: HeadAssets, camera: Pinhole, t: Float[Tensor, "T 3"]) -> Float[Tensor, " T"]:
    """The landmarks' standard deviation in pixels, of heads at these places."""
    return POINT_SHARE * eye_distance(assets) * camera.fx / t[:, 2]


def _last_used(directions: Tensor) -> int:
    used = torch.nonzero((directions != 0).any(0).any(0))
    return int(used[-1]) if len(used) else -1
