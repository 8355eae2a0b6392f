"""A splatter as one would write it in torch alone, for speed: what a compiled kernel has to beat.

Projection is the reference's, in float64 as in the compiled kernel, so that both draw in the same order. The work at
pixels, most of the time, is in float32, tile by tile, with autograd. The result is that of `avatar.splat.splat`: nothing
that reaches `alpha_min` is left out.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.splat.reference import Projected, project
from avatar.splat.sh import sh_degree_of
from avatar.types import Camera, Gaussians, Rendering

TILE = 16  # pixels
CHUNK = 1024  # splats that a tile takes at once, before it looks whether all its pixels are saturated


def splat_plain(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, " 3"],
    *,
    alpha_min: float = 1 / 255,
    alpha_max: float = 0.999,
    t_min: float = 1e-4,
    blur: float = 0.3,
    near: float = 0.01,
) -> Rendering:
    """`avatar.splat.splat` for float32 tensors, without its checks and its other options."""
    splats = project(
        Gaussians(*(t.double() for t in gaussians)),
        camera,
        sh_degree=sh_degree_of(gaussians.sh.shape[1]),
        alpha_min=alpha_min,
        blur=blur,
        near=near,
        antialiased=False,
    )
    across, down = -(-camera.width // TILE), -(-camera.height // TILE)
    members, lengths = tile_lists(splats, across, down)
    # One gather for all tiles: its derivative is one scattered sum instead of one for each tile.
    fields = torch.cat((splats.means, splats.whitening, splats.opacities[:, None], splats.colours), 1).float()
    lists = fields.index_select(0, members).split(lengths.tolist())
    corners = [(TILE * column, TILE * row) for row in range(down) for column in range(across)]
    tiles = [composite(own, *corner, alpha_min, alpha_max, t_min) for own, corner in zip(lists, corners, strict=True)]
    pixels = torch.stack(tiles).reshape(down, across, TILE, TILE, 4).transpose(1, 2).reshape(down * TILE, -1, 4)
    colour, transmittance = pixels[: camera.height, : camera.width].split((3, 1), -1)
    return Rendering(colour + transmittance * background, 1 - transmittance[..., 0])


def tile_lists(splats: Projected, across: int, down: int) -> tuple[Int[Tensor, " pairs"], Int[Tensor, " tiles"]]:
    """The splats whose boxes meet each tile, front to back, one tile after the other, and how many every tile has."""
    means, last_tile = splats.means.detach(), torch.tensor([across - 1, down - 1])
    first = ((means - splats.half_extents) / TILE).floor().clamp(min=0).long()
    last = torch.minimum(((means + splats.half_extents) / TILE).floor(), last_tile.double()).long()
    spans = (last - first + 1).clamp(min=0)
    counts = spans.prod(1)
    owner = torch.arange(len(means)).repeat_interleave(counts)
    nth = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]  # tile of its splat
    column, row = first[owner, 0] + nth % spans[owner, 0], first[owner, 1] + nth // spans[owner, 0]
    tile, order = torch.sort(row * across + column, stable=True)
    return owner[order], torch.bincount(tile, minlength=across * down)


def composite(
    fields: Float[Tensor, "m 9"], left: int, top: int, alpha_min: float, alpha_max: float, t_min: float
) -> Float[Tensor, "P 4"]:
    """Colour without background, and transmittance, at the pixels of the tile with this corner."""
    xs, ys = (corner + torch.arange(TILE) + 0.5 for corner in (left, top))
    colour, transmittance = fields.new_zeros(TILE * TILE, 3), fields.new_ones(TILE * TILE)
    stopped = torch.zeros(TILE * TILE, dtype=torch.bool)
    for part in fields.split(CHUNK) if len(fields) else ():
        x, y, a, b, c, opacity = (column[:, None, None] for column in part[:, :6].unbind(1))
        dx, dy = xs - x, ys[:, None] - y  # [m, 1, TILE], [m, TILE, 1]
        squared = (a * dx + b * dy).square() + (c * dy).square()
        alpha = (opacity * torch.exp(-0.5 * squared)).clamp(max=alpha_max).flatten(1)  # [m, P]
        alpha = torch.where(alpha >= alpha_min, alpha, 0.0)
        with torch.no_grad():
            drawn = (transmittance * torch.cumprod(1 - alpha, 0) >= t_min) & ~stopped
            stopped = ~drawn[-1]
        alpha = torch.where(drawn, alpha, 0.0)
        after = transmittance * torch.cumprod(1 - alpha, 0)
        before = torch.cat((transmittance[None], after[:-1]))
        colour = colour + (before * alpha).T @ part[:, 6:]
        transmittance = after[-1]
        if stopped.all():
            break
    return torch.cat((colour, transmittance[:, None]), 1)
