"""What a drawing of the "gpu" backend did and what it skipped; for people, so it may read back."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.kernels.composite import NEVER_STOPS
from avatar.kernels.project import VISIBLE
from avatar.splat import gpu_draw
from avatar.splat.counters import Counters
from avatar.splat.gpu import pose_on, settings_of
from avatar.splat.gpu_draw import Counted, Drawing, Settings, draw, tile_grid
from avatar.types import Camera, Gaussians, Rendering

HALF_LOG2E = 0.72134752044448170368


@torch.no_grad()
def count_gpu(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], *, everywhere: bool = False, **options: Any
) -> tuple[Rendering, Counters]:
    """Draw without a gradient, and count. `everywhere` looks for every splat at every pixel: the same bits, slowly.

    A block is a tile here: its pixels are drawn in step.
    """
    device = gaussians.means.device
    settings = settings_of(camera, device, **options, everywhere=everywhere)
    background = background.detach().contiguous()
    if len(gaussians.means) == 0:
        tiles = tile_grid(settings.region, gpu_draw.TUNING.tile).tiles
        image = background.repeat(camera.height, camera.width, 1)
        counts = dict.fromkeys(Counters._fields, 0) | {"tiles": tiles, "blocks": tiles}
        return Rendering(image, torch.zeros_like(image[..., 0])), Counters(**counts)
    tensors = Gaussians(*(t.detach().contiguous() for t in gaussians))
    rendering, drawing, found = draw(tensors, pose_on(camera, device), background, settings, count=True)
    return rendering, counters_of(settings, drawing, found)


def counters_of(settings: Settings, drawing: Drawing, found: Counted) -> Counters:
    *hidden, visible = torch.bincount(found.visibility.long(), minlength=VISIBLE + 1).tolist()
    lists, looked_at = drawing.begins.diff(), drawing.chunks * drawing.tuning.step
    shown = torch.where(drawing.places >= 0, found.composited[drawing.places.clamp(min=0).long()], 0).long()
    slots = torch.arange(len(shown), device=shown.device)
    of_splat = torch.searchsorted(drawing.ends, slots, right=True).clamp(max=len(drawing.ends) - 1)
    with_effect = torch.zeros_like(drawing.ends).index_add_(0, of_splat, shown) > 0
    open_tiles = torch.unique(tile_of_pixels(settings, drawing)[drawing.stops == NEVER_STOPS.value])
    tiles, is_visible = drawing.grid.tiles, found.visibility == VISIBLE
    return Counters(
        *hidden,
        visible=visible,
        visible_without_effect=visible - int(with_effect.sum()),
        tiles=tiles,
        tiles_stopped=tiles - len(open_tiles),
        blocks=tiles,
        blocks_stopped=tiles - len(open_tiles),
        pairs=int(lists.sum()),
        pairs_in_boxes=int(drawing.boxes[3].sum()),
        pairs_in_squares=int(tiles_of_squares(found.ellipses, settings, drawing)[is_visible].sum()),
        pairs_processed=int(torch.minimum(lists, looked_at).sum()),
        pixels_evaluated=int(looked_at.sum()) * drawing.tuning.tile**2,
        pixels_composited=int(shown.sum()),
    )


def tile_of_pixels(settings: Settings, drawing: Drawing) -> Int[Tensor, "H W"]:
    """The tile of each pixel; of those outside the region, which are never open, any."""
    rows, columns = (
        torch.arange(size, device=drawing.chunks.device) // drawing.tuning.tile - first
        for size, first in ((settings.height, drawing.grid.first_y), (settings.width, drawing.grid.first_x))
    )
    return rows[:, None] * drawing.grid.across + columns


def tiles_of_squares(ellipses: Float[Tensor, "5 N"], settings: Settings, drawing: Drawing) -> Int[Tensor, " N"]:
    """Tiles that a square of three standard deviations of the longer axis meets."""
    x, y, a, b, c = ellipses
    # The covariance is HALF_LOG2E times the inverse of the squared factor (a, b; 0, c).
    yy = 1 / c.square()
    xx, det = (1 + b.square() * yy) / a.square(), yy / a.square()
    middle = 0.5 * (xx + yy)
    half = 3 * (HALF_LOG2E * (middle + (middle.square() - det).clamp(min=0).sqrt())).sqrt()
    grid, tile = drawing.grid, drawing.tuning.tile
    across = _tiles_between(x - half, x + half, settings.width, grid.first_x, grid.across, tile)
    return across * _tiles_between(y - half, y + half, settings.height, grid.first_y, grid.down, tile)


def _tiles_between(low: Tensor, high: Tensor, pixels: int, first_tile: int, tiles: int, tile: int) -> Tensor:
    first = (low - 0.5).ceil().clamp(0, pixels)
    last = (high - 0.5).floor().clamp(-1, pixels - 1)
    begin = (first / tile).floor().clamp(min=first_tile)
    end = ((last + tile) / tile).floor().clamp(max=first_tile + tiles)
    return torch.where(first <= last, (end - begin).clamp(min=0), 0).long()
