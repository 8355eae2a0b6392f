"""Bundle adjustment of skin points on a turning head: poses, identity and focal length by the pictures alone.

Every point keeps its grey value, in each frame's light (see `texture`), and its place on a head whose expression is
constant. Unknown are the focal length, the identity, each frame's pose, and of each point its grey value and how far it
stands off the mesh. Gauss-Newton; the unknowns of the points are eliminated (Schur complement).
Source: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment: a modern synthesis" (2000), section 6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.head.assets import HeadAssets
from avatar.head.normals import vertex_normals
from data_prep.track.fit.camera import Pinhole, by_pose
from data_prep.track.fit.crops import BlurredCrops, Crops
from data_prep.track.fit.landmark_fit import LandmarkFit
from data_prep.track.fit.motion import Motion, rotations
from data_prep.track.fit.photometric_fit import Skin, trust
from data_prep.track.fit.photometric_term import DEVIATION, ROBUST
from data_prep.track.fit.skin_points import skin_triangles, spread_points
from data_prep.track.fit.surface import SurfacePoints
from data_prep.track.fit.texture import lit_texture

COUNT = 1200  # points, before those that the expression moves are left out
STILL_SHARE = 0.6  # of the points: those that the clip's expressions move least
OFFSET_DEVIATION = 1e-3  # metres off the mesh
DAMPING = 1e-3
MOST_CHANGE = 0.25  # of the logarithm of the focal length, in a step
# Radians and metres of a pose's step: keeps the equations of a frame without visible points solvable.
_STEP_DEVIATION = (0.5, 0.5, 0.5, 0.1, 0.1, 1.0)


@dataclass(frozen=True)
class Adjusted:
    camera: Pinhole
    R: Float[Tensor, "T 3 3"]
    t: Float[Tensor, "T 3"]
    identity: Float[Tensor, " I"]
    offsets: Float[Tensor, " N"]  # metres along the normals


class TurningSkin:
    """The points of one landmark fit, in the frames that it was made from."""

    def __init__(self, assets: HeadAssets, fit: LandmarkFit, camera: Pinhole, crops: Crops) -> None:
        self._assets, self._crops = assets, crops
        constant = _with_one_expression(fit.motion)
        corners, barycentric = spread_points(assets, skin_triangles(assets), COUNT)
        every = SurfacePoints(assets, corners, barycentric, len(fit.identity), fit.expressions)
        moved = (every.positions(fit.identity, fit.motion) - every.positions(fit.identity, constant)).norm(dim=-1)
        moved = moved.square().mean(0)
        kept = moved <= moved.quantile(STILL_SHARE)
        self._corners, self._barycentric = corners[kept], barycentric[kept]
        points = SurfacePoints(assets, self._corners, self._barycentric, len(fit.identity), fit.expressions)
        first = constant[:1]
        self._mean = points.positions(torch.zeros_like(fit.identity), first)[0]  # [N, 3]
        units = torch.eye(len(fit.identity), dtype=torch.float64)
        self._directions = torch.stack([points.positions(unit, first)[0] - self._mean for unit in units], dim=-1)
        normals = vertex_normals(assets.template.double(), assets.faces)[self._corners] * self._barycentric[..., None]
        self._normals = torch.nn.functional.normalize(normals.sum(1), dim=-1)
        self._fit = replace(fit, motion=constant)
        self.start = Adjusted(camera, constant.R, constant.t, fit.identity, self._mean.new_zeros(len(self._mean)))

    def weights(self, at: Adjusted) -> Float[Tensor, "T N"]:
        """How much each point counts in each frame, see `seen_weights`."""
        return self._skin(at).weights(replace(self._fit.motion, R=at.R, t=at.t))

    def _skin(self, at: Adjusted) -> Skin:
        fit = replace(self._fit, identity=at.identity)
        return Skin(self._assets, self._corners, self._barycentric, at.camera, self._crops, fit)

    def step(
        self, at: Adjusted, images: BlurredCrops, weights: Float[Tensor, "T N"], identity_weight: float
    ) -> Adjusted:
        """One step of Gauss-Newton. `identity_weight` is that of the squares of the identity coefficients."""
        T, I = len(at.R), len(at.identity)  # noqa: E741
        basis, camera = self._skin(at).basis, at.camera
        motion = replace(self._fit.motion, R=at.R, t=at.t)
        in_head = self._mean + self._directions @ at.identity + at.offsets[:, None] * self._normals
        in_camera = in_head @ at.R.mT + at.t[:, None]
        pixels = camera.project(in_camera)
        values, gradient = images.sample(pixels, slice(0, T))
        lit = lit_texture(values, weights, basis)
        light = lit.light @ basis.T  # [T, N]: the derivative of a point's value by its grey value, negated
        off = values - light * lit.texture
        robust = weights * trust(off, weights) / (1 + (off / DEVIATION / ROBUST) ** 2) / DEVIATION**2
        grey = (robust * light * values).sum(0) / (robust * light**2).sum(0).clamp(min=1e-9)
        off = values - light * grey
        # Derivatives of the values by poses [T, N, 6], identity and focal length [T, N, I + 1], and offsets [T, N].
        slopes = gradient[:, :, None] @ camera.slopes(in_camera)  # [T, N, 1, 3]
        pose = by_pose(motion, in_camera, slopes)[:, :, 0]
        turned = slopes[:, :, 0] @ at.R
        by_identity = torch.einsum("tnc,nci->tni", turned, self._directions)
        # The head goes away as the focal length grows, so that its size stays.
        by_focal = (gradient * (pixels - pixels.new_tensor([camera.cx, camera.cy]))).sum(-1)
        by_focal = by_focal + slopes[:, :, 0, 2] * at.t[:, None, 2]
        shared = torch.cat((by_identity, by_focal[..., None]), dim=-1)
        by_offset = (turned * self._normals).sum(-1)

        weighted = robust[..., None] * pose
        unknowns = 6 * T + I + 1
        hessian, ours = off.new_zeros(unknowns, unknowns), slice(6 * T, unknowns)
        blocks = weighted.mT @ pose
        hessian[: 6 * T, : 6 * T] = torch.block_diag(*blocks)
        border = (weighted.mT @ shared).flatten(0, 1)
        hessian[: 6 * T, ours], hessian[ours, : 6 * T] = border, border.T
        hessian[ours, ours] = (shared * robust[..., None]).flatten(0, 1).T @ shared.flatten(0, 1)

        def by_point(weight: Float[Tensor, "T N"]) -> Float[Tensor, "N U"]:
            """Sums over the frames of all derivatives times `weight`."""
            poses = (pose * weight[..., None]).transpose(0, 1).flatten(1)
            return torch.cat((poses, torch.einsum("tng,tn->ng", shared, weight)), dim=1)

        slope = by_point(robust * off).sum(0)
        # Eliminate the grey values, then the offsets.
        with_grey, grey_grey = by_point(robust * light), (robust * light**2).sum(0).clamp(min=1e-9)
        grey_slope = (robust * light * off).sum(0)
        share = (robust * light * by_offset).sum(0) / grey_grey
        with_offset = by_point(robust * by_offset) - with_grey * share[:, None]
        offset_offset = (robust * by_offset**2).sum(0) - share**2 * grey_grey + OFFSET_DEVIATION**-2
        offset_slope = (robust * by_offset * off).sum(0) - grey_slope * share + at.offsets * OFFSET_DEVIATION**-2
        for rows, own, gradient_of in ((with_grey, grey_grey, grey_slope), (with_offset, offset_offset, offset_slope)):
            hessian -= rows.T @ (rows / own[:, None])
            slope -= rows.T @ (gradient_of / own)
        hessian.diagonal()[: 6 * T] += off.new_tensor(_STEP_DEVIATION).pow(-2).repeat(T)
        hessian.diagonal()[6 * T : -1] += identity_weight
        hessian[-1, -1] += 1e-2
        slope[6 * T : -1] += identity_weight * at.identity
        hessian.diagonal().mul_(1 + DAMPING)
        step = -torch.linalg.solve(hessian, slope)
        change = math.exp(float(step[-1].clamp(-MOST_CHANGE, MOST_CHANGE)))
        poses = step[: 6 * T].unflatten(0, (T, 6))
        return Adjusted(
            camera=camera._replace(fx=camera.fx * change, fy=camera.fy * change),
            R=rotations(poses[:, :3]) @ at.R,
            t=at.t * off.new_tensor([1.0, 1.0, change]) + poses[:, 3:],
            identity=at.identity + step[6 * T : -1],
            offsets=at.offsets - (offset_slope + with_offset @ step) / offset_offset,
        )


def _with_one_expression(motion: Motion) -> Motion:
    """The same poses, and everything else at its median over the frames."""
    names = ("jaw", "gaze", "eyelids", "expression")
    return replace(
        motion, **{name: getattr(motion, name).median(0).values.expand_as(getattr(motion, name)) for name in names}
    )
