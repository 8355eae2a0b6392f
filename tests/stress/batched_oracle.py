"""A second, independent oracle: the splatter's definition for a batch of small scenes at once, in float64.

`avatar.splat.reference` takes milliseconds a scene, too long for a hundred thousand. Here every splat meets every pixel
as one dense tensor; what is invisible is masked instead of left out. tests/stress/test_batched_oracle.py compares it
with the reference and with finite differences of itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from avatar.splat.sh import sh_basis
from avatar.types import Camera, Gaussians


@dataclass(frozen=True)
class Options:
    """The keyword arguments of avatar.splat.splat, shared by the scenes of a batch."""

    sh_degree: int = 3
    alpha_min: float = 1 / 255
    alpha_max: float = 0.999
    t_min: float = 1e-4
    blur: float = 0.3
    near: float = 0.01
    antialiased: bool = False


@dataclass(frozen=True)
class Batch:
    """B scenes of N splats, all of the same size in pixels and with the same options; float32, as the kernel takes them."""

    gaussians: Gaussians  # every field has B before its own dimensions
    background: Tensor  # [B, 3]
    R_cam_world: Tensor  # [B, 3, 3]
    t_cam_world: Tensor  # [B, 3]
    focal: Tensor  # float64 [B, 2], fx and fy
    centre: Tensor  # float64 [B, 2], cx and cy
    width: int
    height: int
    options: Options = field(default_factory=Options)

    def __len__(self) -> int:
        return len(self.background)

    def camera(self, b: int) -> Camera:
        (fx, fy), (cx, cy) = self.focal[b].tolist(), self.centre[b].tolist()
        return Camera(self.R_cam_world[b], self.t_cam_world[b], fx, fy, cx, cy, self.width, self.height)


class Rounding(NamedTuple):
    """What float32 rounds of the pairs of a sorted splat and a pixel, differentiable, and how large it is; [B, N, H W]."""

    alphas: Tensor
    u: Tensor  # the whitened distance of the pixel from the splat is (u, v)
    v: Tensor
    paint: Tensor  # what the pair adds to the loss, all its parts taken as positive, as a function of the colour alone
    rest: Tensor  # [B, H W] the same of the background
    weight: Tensor  # of an error in alpha, relative to alpha's
    u_range: Tensor  # largest |u| that float32 has to hold on the way to this u
    v_range: Tensor

    def noise(self, generator: torch.Generator) -> Tensor:
        """A sum whose gradient is what rounding errors of random sign and relative size 1 leave in the gradients."""

        def signs(like: Tensor) -> Tensor:
            return torch.randint(0, 2, like.shape, generator=generator) * 2.0 - 1.0

        weighted = self.alphas.detach() * self.weight
        pairs = (
            signs(self.u) * self.weight * self.alphas
            + signs(self.u) * weighted * self.u_range * self.u
            + signs(self.u) * weighted * self.v_range * self.v
            + signs(self.u) * self.paint
        )
        return pairs.sum() + (signs(self.rest) * self.rest).sum()


class Drawn(NamedTuple):
    image: Tensor  # [B, H, W, 3]
    alpha: Tensor  # [B, H, W]
    ambiguous: Tensor  # bool [B, H, W]: a cut-off is met there to within what float32 can tell
    ambiguous_colour: Tensor  # bool [B, N]: a channel of the colour is at its clamp to within what float32 can tell
    lengths: Tensor  # [B, N] root of the sum of both variances on the image plane, before the blur; pixels
    rounding: Rounding


def draw(batch: Batch, gaussians: Gaussians, background: Tensor, grad_image: Tensor, grad_alpha: Tensor) -> Drawn:
    """All scenes of a batch, in float64, from `gaussians` and `background` in place of the batch's own (as leaves).

    The cotangents [B, H, W, 3] and [B, H, W] are only needed for the size of rounding errors in the gradients.
    """
    o = batch.options
    means, quats, scales, opacities, sh = gaussians
    R, t = batch.R_cam_world.double(), batch.t_cam_world.double()
    # In this order of operations, as every backend: a near-tie in depth must break alike.
    p = [R[:, k, None, 0] * means[..., 0] + R[:, k, None, 1] * means[..., 1] + R[:, k, None, 2] * means[..., 2]
         + t[:, k, None] for k in range(3)]  # fmt: skip
    visible = p[2].detach() >= o.near
    order = torch.sort(torch.where(visible, p[2].detach(), torch.inf), dim=1, stable=True).indices
    visible = visible.gather(1, order)
    x, y, z = (torch.where(visible, v.gather(1, order), float(k == 2)) for k, v in enumerate(p))
    means, quats, scales, sh = (_reorder(v, order) for v in (means, quats, scales, sh))
    opacities = opacities.gather(1, order)

    # Covariance on the image plane: F F^T + blur.
    focal, centre = batch.focal[:, None], batch.centre[:, None]
    size = torch.tensor([batch.width, batch.height], dtype=torch.float64)
    margin = 0.3 * 0.5 * size / focal
    slope = torch.stack((x, y), -1) / z[..., None]
    slope = torch.minimum(torch.maximum(slope, -centre / focal - margin), (size - centre) / focal + margin)
    M = _rotations(quats) * scales[..., None, :]  # [B, N, 3, 3]
    RM = R[:, None] @ M
    F = focal[..., None] / z[..., None, None] * (RM[..., :2, :] - slope[..., None] * RM[..., 2:, :])
    f, g = F.unbind(-2)
    yy, xy = g.square().sum(-1) + o.blur, (f * g).sum(-1)
    area = torch.linalg.vector_norm(torch.linalg.cross(f, g), dim=-1)
    det = area.square() + o.blur * (f.square().sum(-1) + g.square().sum(-1)) + o.blur**2
    if o.antialiased:
        opacities = opacities * area / det.sqrt()
    visible = visible & torch.isfinite(det)

    # Alpha of every splat at every pixel.
    middle = torch.stack((x, y), -1) / z[..., None] * focal + centre
    rows, columns = torch.arange(batch.height) + 0.5, torch.arange(batch.width) + 0.5
    pixels = torch.stack(torch.meshgrid(rows.double(), columns.double(), indexing="ij"), -1).reshape(-1, 2)
    dx, dy = pixels[:, 1] - middle[..., :1], pixels[:, 0] - middle[..., 1:]  # [B, N, P]
    u = (yy / det).sqrt()[..., None] * dx - (xy / (yy * det).sqrt())[..., None] * dy
    v = dy / yy.sqrt()[..., None]
    unclamped = torch.where(visible[..., None], opacities[..., None] * torch.exp(-0.5 * (u * u + v * v)), 0.0)
    alphas = unclamped.clamp(max=o.alpha_max)
    hit = (alphas >= o.alpha_min) & visible[..., None]  # at opacities below alpha_min, nowhere
    alphas = torch.where(hit, alphas, 0.0)

    # Compositing: once the transmittance would fall below t_min it stays there.
    after = torch.cumprod(1 - alphas.detach(), 1)
    drawn = after >= o.t_min
    before = torch.cat((torch.ones_like(after[:, :1]), after), 1)[:, :-1]
    alphas = torch.where(drawn, alphas, 0.0)
    weights = alphas * torch.cumprod(torch.cat((torch.ones_like(after[:, :1]), 1 - alphas), 1), 1)[:, :-1]
    end = torch.prod(1 - alphas, 1)  # [B, P]
    away = torch.where(visible[..., None], means + (R.mT @ t[..., None])[:, None, :, 0], 1.0)
    direction = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True)
    raw_colours = (
        torch.einsum("bnk,bnkc->bnc", _basis(direction, o.sh_degree), sh[:, :, : (o.sh_degree + 1) ** 2]) + 0.5
    )
    colours = torch.where(raw_colours > 0, raw_colours, 0.0)
    image = torch.einsum("bnp,bnc->bpc", weights, colours) + end[..., None] * background[:, None]

    with torch.no_grad():
        odds = (alphas / (1 - alphas)).cumsum(1)
        reached = before >= 0.5 * o.t_min
        near_min = _near(unclamped, o.alpha_min, 1e-4) if o.alpha_min > 0 else torch.zeros_like(drawn)
        near_end = _near(after, o.t_min, 1e-5 + 3e-5 * odds) if o.t_min > 0 else torch.zeros_like(drawn)
        ambiguous = ((near_min | near_end | _near(unclamped, o.alpha_max, 1e-5)) & reached).any(1)
        length = F.square().sum((-1, -2)).sqrt()
        unclear = (raw_colours.abs() <= 1e-6 * (1 + sh.abs().sum(2))).any(-1)
        # The kernel finds u and v from those of the corner of a tile of 32 x 32 pixels.
        v_range = v.abs() + 32 / yy.sqrt()[..., None]
        u_range = u.abs() + 32 * ((yy / det).sqrt() + (xy / (yy * det).sqrt()).abs())[..., None]
        # An error of one alpha is one of 1 - alpha, so of all transmittances behind, alpha / (1 - alpha) times as large.
        condition = 1 + odds[:, -1:].sum(1)
        own = 0.1 * (u.abs() * u_range + v.abs() * v_range)  # of an alpha far out in the tail
    grad = grad_image.flatten(1, 2).abs()
    shades = torch.einsum("bpc,bnc->bnp", grad, colours.abs())
    paint = (condition[:, None] + own) * weights.detach() * shades
    rest = condition * end.detach() * torch.einsum("bpc,bc->bp", grad, background)
    with torch.no_grad():
        # dL/dalpha_k = T_k g.c_k - behind_k / (1 - alpha_k), where behind_k is what is left of a sum over all splats.
        total = paint.sum(1) + rest.abs() + condition * end * grad_alpha.flatten(1).abs()
        weight = (condition[:, None] + own) * before * shades + total[:, None] / (1 - alphas)
        weight = torch.where((unclamped <= o.alpha_max) & hit & drawn, weight, 0.0)
    shape = (len(batch), batch.height, batch.width)
    return Drawn(
        image.reshape(*shape, 3),
        1 - end.reshape(shape),
        ambiguous.reshape(shape),
        torch.zeros_like(unclear).scatter(1, order, unclear),
        torch.zeros_like(length).scatter(1, order, length),
        Rounding(alphas, u, v, paint, rest, weight, u_range, v_range),
    )


def _near(value: Tensor, edge: float, margin: Tensor | float) -> Tensor:
    return (value - edge).abs() <= margin * edge


def _reorder(field: Tensor, order: Tensor) -> Tensor:
    index = order.reshape(*order.shape, *(1 for _ in field.shape[2:])).expand(field.shape)
    return field.gather(1, index)


def _basis(directions: Tensor, degree: int) -> Tensor:
    return sh_basis(directions.flatten(0, 1), degree).unflatten(0, directions.shape[:2])


def _rotations(quats: Tensor) -> Tensor:
    """[B, N, 3, 3] of quaternions (w, x, y, z) of any length: v + 2 w (q x v) + 2 q x (q x v), for each axis v."""
    zero = (quats == 0).all(-1, keepdim=True)
    quats = torch.where(zero, torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype), quats)
    quats = quats / torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
    axes = torch.eye(3, dtype=quats.dtype).expand(*quats.shape[:2], 3, 3)
    q = quats[..., None, 1:].expand_as(axes)
    turned = torch.linalg.cross(q, axes)
    return (axes + 2 * quats[..., :1, None] * turned + 2 * torch.linalg.cross(q, turned)).mT
