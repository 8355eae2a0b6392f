"""The motion of a clip improved by its pictures: every point of the skin keeps its colour, in each frame's light.

The texture is the mean over the clip: the pictures say how frames lie to each other, and the landmarks, with less weight,
where on the skin the head model lies. From coarse to fine: pictures are blurred first, so that a face that is some pixels
off still finds its way. Points that do not keep their colour, such as those of glasses, count little. Every fifth point
takes no part; what these gain decides whether the result is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from data_prep.progress import Progress
from data_prep.track.faces import landmark_groups as groups
from data_prep.track.fit.camera import Pinhole, to_camera
from data_prep.track.fit.chunks import over_chunks
from data_prep.track.fit.crops import BlurredCrops, Crops, Images, Mattes, cut_out
from data_prep.track.fit.frame_poses import Motion, at_rest
from data_prep.track.fit.landmark_fit import POINT_SHARE, LandmarkFit, eye_distance
from data_prep.track.fit.landmark_term import LandmarkTerm
from data_prep.track.fit.levenberg_marquardt import minimise
from data_prep.track.fit.occlusion import covered_shares
from data_prep.track.fit.photometric_term import PhotometricTerm, SkinValues
from data_prep.track.fit.skin_points import seen_weights, skin_triangles, spread_points
from data_prep.track.fit.surface import SurfacePoints
from data_prep.track.fit.texture import light_basis, lit_texture

EYES_IN_CROPS = 110.0  # pixels between the eyes, at most
BLURS = (3.0, 1.2)  # per cent of the distance between the eyes
NEAR_LIPS = 0.25  # distances between the eyes
INNER_FACE = 0.5  # likewise, from any feature: hair that falls otherwise as the head tilts lies farther outside
ROUNDS, ITERATIONS = 6, 1  # textures for each blur, and steps for each texture: it lags behind the motion
COARSE_SHARE = 2  # of the fitted points one of so many counts at the first blur, where neighbours say the same
LANDMARK_SHARE, FEATURE_SHARE = 0.05, 0.2  # of the landmarks' weights that stay; of lips, lids and distances
HELD_OUT = 5  # one point of so many
# dB that the held-out points must gain. On six demo people whose motion is known (120 frames) the error of the face's
# vertices, without what is the same in all frames, fell to 0.39 to 0.53 of what it was, at gains from 2.0 to 3.3 dB.
LEAST_GAIN = 1.0
_FRAMES_AT_ONCE = 16


@dataclass(frozen=True)
class PhotometricFit:
    motion: Motion  # of the pictures' fit where that is taken, else of the landmarks'
    before: float  # PSNR of the held-out points against their mean texture, dB: of the landmarks' fit
    after: float  # of the fit to the pictures
    covered: Float[Tensor, " T"]  # share of the face before which something is, by the fit to the pictures

    @property
    def is_taken(self) -> bool:
        return self.after - self.before >= LEAST_GAIN


def fit_pictures(
    assets: HeadAssets, start: LandmarkFit, camera: Pinhole, images: Images, mattes: Mattes, progress: Progress
) -> PhotometricFit:
    """`images` and `mattes` are by the frames' numbers. The identity stays as it is."""
    T, motion = len(start.motion), start.motion
    corners, barycentric = spread_points(assets, skin_triangles(assets))
    number = torch.arange(len(corners))
    is_held = number % HELD_OUT == HELD_OUT // 2
    eyes = float(start.term.unit.mean()) / POINT_SHARE  # pixels of the frames
    points = SurfacePoints(assets, corners, barycentric, len(start.identity), start.expressions)
    boxes = _boxes(points, start.identity, motion, camera)
    frames = progress(start.frames.tolist(), T, "reading faces")
    crops = cut_out(images, mattes, frames, boxes, min(1.0, EYES_IN_CROPS / eyes))
    skin = _Skin(assets, corners, barycentric, camera, crops, start)
    held, compared_at = skin.subset(is_held), dict.fromkeys(BLURS, ~is_held)
    compared_at[BLURS[0]] = ~is_held & (number % COARSE_SHARE == 0)
    # Points that fit badly because the mouth has yet to move, and must have their say in it.
    on_mouth = _near(assets, start, points, groups.LIPS, NEAR_LIPS)
    terms = (_quieter(start.term), start.priors, start.smoothness)
    first = skin.weights(motion)
    for chosen in (is_held, ~is_held):
        _refuse_unseen(first[:, chosen])
    weights = first
    levels = [blur for blur in BLURS for _ in range(ROUNDS)]
    blurred, compared, seen, last = None, None, None, None
    for blur in progress(levels, len(levels), "fitting to pictures", "textures"):
        if blur != last:
            blurred, seen, last = None, None, blur  # frees the memory of the level before
            blurred = BlurredCrops(crops, 0.01 * blur * eyes * crops.scale)
            weights = first if motion is start.motion else skin.weights(motion)
            compared = skin.subset(compared_at[blur])
            seen = SkinValues(compared.points, camera, blurred)
        assert blurred is not None and compared is not None and seen is not None
        own = weights[:, compared_at[blur]]
        values = seen.at(start.identity, motion)
        wanted = lit_texture(values, own, compared.basis).values(compared.basis)
        own = own * torch.where(on_mouth[compared_at[blur]], 1.0, _trust(values - wanted, own))
        term = PhotometricTerm(seen, wanted, own)
        motion = minimise((term, *terms), start.identity, motion, ITERATIONS).motion
    assert blurred is not None
    before = _psnr(held.values(blurred, start.motion), first[:, is_held], held.basis)
    after = _psnr(held.values(blurred, motion), weights[:, is_held], held.basis)
    is_inner = _near(assets, start, points, groups.FEATURES, INNER_FACE)
    values, places = skin.values(blurred, motion)[:, is_inner], _at_rest(points, start)[is_inner]
    covered = covered_shares(values, weights[:, is_inner], skin.basis[is_inner], places)
    done = PhotometricFit(motion, before, after, covered)
    return done if done.is_taken else replace(done, motion=start.motion)


class _Skin:
    """Points of the skin in the pictures."""

    def __init__(
        self,
        assets: HeadAssets,
        corners: Int[Tensor, "N 3"],
        barycentric: Float[Tensor, "N 3"],
        camera: Pinhole,
        crops: Crops,
        start: LandmarkFit,
    ) -> None:
        self._of = assets, camera, crops, start
        self._corners, self._barycentric = corners, barycentric
        self.points = SurfacePoints(assets, corners, barycentric, len(start.identity), start.expressions)
        self.basis = light_basis(assets, corners, barycentric)

    def subset(self, chosen: Tensor) -> _Skin:
        assets, camera, crops, start = self._of
        return _Skin(assets, self._corners[chosen], self._barycentric[chosen], camera, crops, start)

    def values(self, images: BlurredCrops, motion: Motion) -> Float[Tensor, "T N"]:
        _, camera, _, start = self._of
        return SkinValues(self.points, camera, images).at(start.identity, motion)

    def weights(self, motion: Motion) -> Float[Tensor, "T N"]:
        """How much each point counts in each frame, see `seen_weights`."""
        assets, camera, crops, start = self._of
        vertices = torch.arange(assets.num_vertices)[:, None].expand(-1, 3)
        alone = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(len(vertices), 3)
        every = SurfacePoints(assets, vertices, alone, len(start.identity), start.expressions)
        faces, corners, barycentric = assets.faces.numpy(), self._corners.numpy(), self._barycentric.numpy()

        def of(chunk: slice) -> np.ndarray:
            at = to_camera(motion[chunk], every.positions(start.identity, motion[chunk]))
            screens = crops.to_crop(camera.project(at), chunk)
            rows = []
            for k, matte in enumerate(crops.matte[chunk]):
                screen = np.concatenate((screens[k].numpy(), at[k, :, 2:].numpy()), axis=1)
                rows.append(seen_weights(screen, at[k].numpy(), faces, corners, barycentric, matte))
            return np.stack(rows)

        return torch.from_numpy(np.concatenate(over_chunks(of, len(motion), _FRAMES_AT_ONCE)))


def _boxes(points: SurfacePoints, identity: Tensor, motion: Motion, camera: Pinhole) -> Float[np.ndarray, "T 4"]:
    def of(chunk: slice) -> Tensor:
        at = camera.project(to_camera(motion[chunk], points.positions(identity, motion[chunk])))
        return torch.cat((at.amin(1), at.amax(1)), dim=1)

    return torch.cat(over_chunks(of, len(motion), _FRAMES_AT_ONCE)).numpy()


def _quieter(term: LandmarkTerm) -> LandmarkTerm:
    """The landmarks as an anchor. What the skin says little about keeps more of its weight, and the irises all of it.

    Landmarks between the features would have a fifth of all weight and two thirds of the time: they are left out.
    """
    term = term.of(torch.from_numpy(np.flatnonzero(np.isin(term.landmarks, groups.FEATURES + groups.IRISES))))
    is_feature = torch.from_numpy(np.isin(term.landmarks, groups.LIPS + groups.LIDS))
    is_iris = torch.from_numpy(np.isin(term.landmarks, groups.IRISES))
    share = torch.where(is_iris, 1.0, torch.where(is_feature, FEATURE_SHARE, LANDMARK_SHARE))
    return replace(term, weights=term.weights * share, pair_weights=term.pair_weights * FEATURE_SHARE)


def _refuse_unseen(weights: Float[Tensor, "T N"]) -> None:
    if not (weights > 0).any():
        raise UserError(
            "the mattes show nothing of the face in any frame, so that its pictures cannot be fitted to: look at the "
            "video, or give mattes of the person with --matte"
        )


def _psnr(values: Float[Tensor, "T N"], weights: Float[Tensor, "T N"], basis: Float[Tensor, "N B"]) -> float:
    """Of the median point's grey values, in 0 to 1, against its texture in each frame's light, in dB."""
    _refuse_unseen(weights)
    wanted = lit_texture(values, weights, basis).values(basis)
    error = _mean_squares(values - wanted, weights)[weights.sum(0) > 0].median()
    return float(-10.0 * torch.log10(error.clamp(min=1e-12)))


def _mean_squares(residuals: Float[Tensor, "T N"], weights: Float[Tensor, "T N"]) -> Float[Tensor, " N"]:
    return (weights * residuals**2).sum(0) / weights.sum(0).clamp(min=1e-9)


def _trust(residuals: Float[Tensor, "T N"], weights: Float[Tensor, "T N"]) -> Float[Tensor, " N"]:
    """Weights of the points by how well they keep their colour: 1 for the better half, less for glasses, hair and gloss.

    These stand off the skin, and move otherwise than it.
    """
    own = _mean_squares(residuals, weights)
    return (own[weights.sum(0) > 0].median() / own.clamp(min=1e-12)).clamp(max=1.0)


def _near(
    assets: HeadAssets, start: LandmarkFit, points: SurfacePoints, landmarks: Sequence[int], reach: float
) -> Bool[Tensor, " N"]:
    """Points within `reach` distances between the eyes of any of these landmarks, at rest."""
    places = _at_rest(start.term.points, start)[torch.from_numpy(np.isin(start.term.landmarks, landmarks))]
    skin = _at_rest(points, start)
    if not len(places):
        return torch.zeros(len(skin), dtype=torch.bool)
    return torch.cdist(skin, places).amin(1) < reach * eye_distance(assets)


def _at_rest(points: SurfacePoints, start: LandmarkFit) -> Float[Tensor, "N 3"]:
    pose = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64)
    return points.positions(start.identity, at_rest(*pose, len(start.expressions)))[0]
