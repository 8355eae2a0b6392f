"""Splatting in plain torch and float64: the oracle that every kernel is compared with.

Semantics: Zwicker et al., "EWA splatting" (2002) and Kerbl et al., "3D Gaussian splatting" (2023), with the choices
stated at `avatar.splat.splat`. Nothing here is approximate: what is left out of a block of pixels cannot reach
`alpha_min` in it. Memory is bounded by evaluating blocks of pixels one after the other and recomputing each in the
backward pass.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from avatar.splat.options import Options
from avatar.splat.sh import sh_colours
from avatar.types import Camera, FeatureGaussians, Gaussians, Rendering

MAX_EVALUATIONS = 1 << 18  # splats times pixels held at once


class Projected(NamedTuple):
    """The splats that can show, front to back, on the image plane; M of them.

    `whitening` holds (a, b, c) of the upper triangular matrix [[a, b], [0, c]] whose product with (x, y) - mean has the
    length of the Mahalanobis distance: a squared distance found in this way does not cancel, unlike the conic's.
    """

    means: Float[Tensor, "M 2"]  # pixels
    whitening: Float[Tensor, "M 3"]  # 1 / pixels
    opacities: Float[Tensor, " M"]
    colours: Float[Tensor, "M C"]
    half_extents: Float[Tensor, "M 2"]  # pixels; of the box around the ellipse where alpha reaches alpha_min


def splat_reference(
    gaussians: Gaussians | FeatureGaussians,
    camera: Camera,
    background: Float[Tensor, " C"],
    options: Options,
    block: int = 16,
) -> Rendering:
    """`avatar.splat.splat` without its checks, computed in float64 on the tensors' device, returned in their dtype.

    Without options.sh_degree `gaussians` have features, which are drawn as they are.
    `block` is the side of the squares of pixels that are evaluated at once; the result does not depend on it. The squares
    lie alike in every region, so that a pixel gets the same bits in all of them.
    """
    dtype = gaussians.means.dtype
    region = options.region
    first_column, first_row = region.left // block * block, region.top // block * block
    splats = project(gaussians._make(t.double() for t in gaussians), camera, options)
    image_rows, alpha_rows = [], []
    for top in range(first_row, region.bottom, block):
        images, alphas = [], []
        for left in range(first_column, region.right, block):
            bottom, right = min(top + block, camera.height), min(left + block, camera.width)
            pixels = _pixel_centres(left, top, right, bottom, splats.means)
            inside = _reaches(splats, left, top, right, bottom)
            arguments = (pixels, *(t[inside] for t in splats[:4]), background.double(), *options[1:4])
            colour, transmittance = checkpoint(_composite, *arguments, use_reentrant=False)  # pyright: ignore
            images.append(colour.reshape(bottom - top, right - left, -1))
            alphas.append(1 - transmittance.reshape(bottom - top, right - left))
        image_rows.append(torch.cat(images, dim=1))
        alpha_rows.append(torch.cat(alphas, dim=1))
    # The blocks reach over the region's edges; all around it is background.
    inside = slice(region.top, region.bottom), slice(region.left, region.right)
    drawn = (
        slice(region.top - first_row, region.bottom - first_row),
        slice(region.left - first_column, region.right - first_column),
    )
    image = background.double().repeat(camera.height, camera.width, 1)
    alpha = image.new_zeros(camera.height, camera.width)
    image[inside], alpha[inside] = torch.cat(image_rows)[drawn], torch.cat(alpha_rows)[drawn]
    return Rendering(image.to(dtype), alpha.to(dtype))


def project(gaussians: Gaussians | FeatureGaussians, camera: Camera, options: Options) -> Projected:
    """Project float64 Gaussians, leave out those that cannot show anywhere, sort by depth and then by index."""
    sh_degree, alpha_min, blur = options.sh_degree, options.alpha_min, options.blur
    R = camera.R_cam_world.to(gaussians.means)
    t = camera.t_cam_world.to(gaussians.means)
    # Written out, so that every backend that computes in float64 rounds a depth, and so breaks near-ties, in the same way.
    depth = _row_times(R[2].detach(), gaussians.means.detach()) + t[2].detach()
    visible = (depth >= options.near).nonzero()[:, 0]
    visible = visible[torch.sort(depth[visible], stable=True).indices]
    means, quats, scales, opacities, looks = (field[visible] for field in gaussians)

    x, y, z = (_row_times(R[i], means) + t[i] for i in range(3))
    tan_x, tan_y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    slope_x = (x / z).clamp(-camera.cx / camera.fx - 0.3 * tan_x, (camera.width - camera.cx) / camera.fx + 0.3 * tan_x)
    slope_y = (y / z).clamp(-camera.cy / camera.fy - 0.3 * tan_y, (camera.height - camera.cy) / camera.fy + 0.3 * tan_y)
    zero = torch.zeros_like(z)
    J = torch.stack(
        (
            torch.stack((camera.fx / z, zero, -camera.fx * slope_x / z), -1),
            torch.stack((zero, camera.fy / z, -camera.fy * slope_y / z), -1),
        ),
        -2,
    )
    # The blurred covariance is F F^T + blur. Its determinant by Cauchy-Binet is a sum of squares: it cannot cancel.
    F = J @ R @ (_rotation_matrices(quats) * scales[:, None, :])
    row_x, row_y = F[:, 0], F[:, 1]
    cov_xx, cov_yy, cov_xy = (
        row_x.square().sum(-1) + blur,
        row_y.square().sum(-1) + blur,
        (row_x * row_y).sum(-1),
    )
    area = torch.linalg.vector_norm(torch.linalg.cross(row_x, row_y), dim=-1)
    det = area.square() + blur * (row_x.square().sum(-1) + row_y.square().sum(-1)) + blur**2
    solid = (det > 0) & torch.isfinite(det)  # without blur a splat can be seen edge-on, as nothing
    x, y, z, cov_xx, cov_xy, cov_yy, area, det, opacities, looks, means = (
        v[solid] for v in (x, y, z, cov_xx, cov_xy, cov_yy, area, det, opacities, looks, means)
    )
    if options.antialiased:
        opacities = opacities * area / det.sqrt()
    keep = opacities >= alpha_min
    x, y, z, cov_xx, cov_xy, cov_yy, det, opacities, looks, means = (
        v[keep] for v in (x, y, z, cov_xx, cov_xy, cov_yy, det, opacities, looks, means)
    )
    whitening = torch.stack(((cov_yy / det).sqrt(), -cov_xy / (cov_yy.sqrt() * det.sqrt()), 1 / cov_yy.sqrt()), dim=-1)
    if sh_degree is not None:
        centre = -(R.T @ t)
        directions = torch.nn.functional.normalize(means - centre, dim=-1, eps=0.0)
        looks = sh_colours(looks, directions, sh_degree)
    with torch.no_grad():
        radius = (2 * torch.log(opacities / alpha_min)).sqrt() if alpha_min > 0 else torch.full_like(z, torch.inf)
        half_extents = radius[:, None] * torch.stack((cov_xx, cov_yy), -1).sqrt()
    return Projected(
        torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), -1),
        whitening,
        opacities,
        looks,
        half_extents,
    )


def _row_times(row: Float[Tensor, " 3"], points: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    return row[0] * points[:, 0] + row[1] * points[:, 1] + row[2] * points[:, 2]


def _rotation_matrices(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotations of quaternions (w, x, y, z) of any length; a zero quaternion is the identity, with zero gradient."""
    is_zero = (quats == 0).all(-1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).to(quats)
    quats = torch.where(is_zero, identity, quats)
    w, x, y, z = (quats / torch.linalg.vector_norm(quats, dim=-1, keepdim=True)).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _pixel_centres(left: int, top: int, right: int, bottom: int, like: Tensor) -> Float[Tensor, "P 2"]:
    ys, xs = torch.meshgrid(
        torch.arange(top, bottom, dtype=like.dtype, device=like.device) + 0.5,
        torch.arange(left, right, dtype=like.dtype, device=like.device) + 0.5,
        indexing="ij",
    )
    return torch.stack((xs.flatten(), ys.flatten()), -1)


def _reaches(splats: Projected, left: int, top: int, right: int, bottom: int) -> Int[Tensor, " m"]:
    """Indices of the splats whose support meets the block, generously rounded."""
    low = splats.means.detach() - splats.half_extents * (1 + 1e-9) - 1e-6
    high = splats.means.detach() + splats.half_extents * (1 + 1e-9) + 1e-6
    outside = (high[:, 0] < left) | (low[:, 0] > right) | (high[:, 1] < top) | (low[:, 1] > bottom)
    return (~outside).nonzero()[:, 0]


def _composite(
    pixels: Float[Tensor, "P 2"],
    means: Float[Tensor, "m 2"],
    whitening: Float[Tensor, "m 3"],
    opacities: Float[Tensor, " m"],
    colours: Float[Tensor, "m C"],
    background: Float[Tensor, " C"],
    alpha_min: float,
    alpha_max: float,
    t_min: float,
) -> tuple[Float[Tensor, "P C"], Float[Tensor, " P"]]:
    """Front-to-back compositing of m sorted splats at P pixel centres: colour over the background, transmittance."""
    image = pixels.new_zeros(len(pixels), len(background))
    # Minus an empty sum, so that the outputs have a gradient (zero) where nothing is drawn.
    transmittance = pixels.new_ones(len(pixels)) - opacities[:0].sum()
    stopped: Bool[Tensor, " P"] = torch.zeros(len(pixels), dtype=torch.bool, device=pixels.device)
    step = max(1, MAX_EVALUATIONS // len(pixels))
    for start in range(0, len(means), step):
        if stopped.all():
            break
        part = slice(start, start + step)
        d = pixels[None] - means[part, None]  # [m, P, 2]
        a, b, c = whitening[part, None].unbind(-1)
        squared = (a * d[..., 0] + b * d[..., 1]).square() + (c * d[..., 1]).square()
        alpha = (opacities[part, None] * torch.exp(-0.5 * squared)).clamp(max=alpha_max)
        alpha = torch.where(alpha >= alpha_min, alpha, 0.0)
        with torch.no_grad():
            # The transmittance only falls, so the first splat that brings it below t_min and all after it are marked.
            drawn = (transmittance * torch.cumprod(1 - alpha, 0) >= t_min) & ~stopped
            stopped = ~drawn[-1]
        alpha = torch.where(drawn, alpha, 0.0)
        after = torch.cumprod(1 - alpha, 0)
        before = torch.cat((torch.ones_like(after[:1]), after[:-1]))
        image = image + torch.einsum("mp,mc->pc", transmittance * before * alpha, colours[part])
        transmittance = transmittance * after[-1]
    return image + transmittance[:, None] * background, transmittance
