"""The launches of a drawing on a GPU; no autograd, and nothing that waits but `needed_pairs`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.kernels.bin import FEATURE_FIELDS, FIELDS, expand, gather
from avatar.kernels.composite import composite
from avatar.kernels.composite_backward import MOMENTS
from avatar.kernels.composite_features import composite_features
from avatar.kernels.launch import start
from avatar.kernels.project import POISON, project
from avatar.splat.cpu import CannotDraw
from avatar.splat.gpu_buffers import MAX_PAIRS, Kind, capacity_of
from avatar.splat.options import Options, Region
from avatar.tensors import check_finite
from avatar.types import FeatureGaussians, Gaussians, Rendering

ALIGNED = 16  # values; what Triton sees of a number that it may load as vectors by


@dataclass(frozen=True)
class Tuning:
    """How the kernels cut their work. Results depend on tile and steps in their last bits only."""

    tile: int = 8  # pixels, width and height; a power of two
    step: int = 8  # splats that are composited at a time
    backward_step: int = 4
    warps: int = 2  # of a tile
    backward_warps: int = 1
    backward_group: int = 16  # channels of features at a time
    lanes: int = 128  # Gaussians or pairs of a program
    backward_lanes: int = 32
    summed: int = 1  # Gaussians of a program that sums their pairs, `summed_lanes` at a time
    summed_lanes: int = 64

    @property
    def chunk(self) -> int:
        """Records of a tile begin at multiples of it."""
        return max(self.step, self.backward_step)

    @property
    def for_features(self) -> Tuning:
        """Products of matrices need more splats at a time, and the registers of more warps."""
        steps = {"step": max(self.step, 16), "backward_step": max(self.backward_step, 8)}
        return replace(self, **steps, warps=max(self.warps, 4), backward_warps=max(self.backward_warps, 4))


TUNING = Tuning()


class Settings(NamedTuple):
    """Checked options, and what they need of the camera but for its pose."""

    intrinsics: Float[Tensor, " 10"]  # float64, see avatar.kernels.geometry
    width: int
    height: int
    options: Options

    @property
    def is_whole(self) -> bool:
        return self.options.region == (0, 0, self.width, self.height)


class Grid(NamedTuple):
    """The tiles that meet the region. They lie where those of the whole image do, so that a pixel gets the same bits."""

    first_x: int
    first_y: int
    across: int
    down: int

    @property
    def tiles(self) -> int:
        return self.across * self.down

    @property
    def place(self) -> tuple[int, int, int]:
        return self.first_x, self.first_y, self.across


class Drawing(NamedTuple):
    """What the backward pass needs of a forward pass; see the kernels for the buffers."""

    tuning: Tuning
    grid: Grid
    capacity: int
    order: Int[Tensor, " N"]
    ends: Int[Tensor, " N"]
    boxes: Int[Tensor, "4 N"]
    begins: Int[Tensor, " B"]
    records: Float[Tensor, "F stride"]
    places: Int[Tensor, " capacity"]
    transmittances: Float[Tensor, "H W"]
    stops: Int[Tensor, "H W"]
    chunks: Int[Tensor, " tiles"]


def draw(
    gaussians: Gaussians | FeatureGaussians,
    pose: Float[Tensor, " 12"],
    background: Float[Tensor, " C"],
    settings: Settings,
) -> tuple[Rendering, Drawing]:
    """Draw contiguous tensors of at least one Gaussian, seen from `pose` (float64, see avatar.splat.pose)."""
    device, s, o = gaussians.means.device, settings, settings.options
    N, channels, stored = len(gaussians.means), len(background), gaussians[4].shape[1]
    has_features = o.sh_degree is None
    check_counted(f"{N} Gaussians", N * max(MOMENTS.value, 0 if has_features else 3 * stored))
    tuning = TUNING.for_features if has_features else TUNING
    grid, warps = tile_grid(o.region, tuning.tile), tuning.lanes // 32

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    depths, ellipses = empty(N, dtype=torch.float64), empty(5, N, dtype=torch.float64)
    looks, boxes = empty(2 if has_features else 5, N), empty(4, N, dtype=torch.int32)
    start(
        project,
        programs(N, tuning.lanes),
        *(*gaussians, pose, s.intrinsics, o.alpha_min, o.sh_degree or 0, channels, N, s.width, s.height, *grid),
        *(depths, ellipses, looks, boxes),
        warps=warps,
        STORED=0 if has_features else stored,
        ANTIALIASED=o.antialiased,
        TILE=tuning.tile,
        BLOCK=tuning.lanes,
    )
    order = torch.sort(depths, stable=True).indices
    ends = boxes[3].index_select(0, order).cumsum(0)
    kind = Kind(device, N, grid.tiles, o.alpha_min, channels if has_features else 0)
    capacity = capacity_of(kind, lambda: needed_pairs(gaussians, pose, background, boxes, ends))

    stride = programs(programs(capacity, tuning.chunk) * tuning.chunk + grid.tiles * tuning.chunk, ALIGNED) * ALIGNED
    check_counted(f"{capacity} pairs of {grid.tiles} tiles and a splat", MOMENTS.value * stride)
    key_type = torch.int16 if grid.tiles < 2**15 - 1 else torch.int32
    keys, splats, corners = empty(capacity, dtype=key_type), empty(capacity, dtype=torch.int32), empty(2, capacity)
    fields = FEATURE_FIELDS if has_features else FIELDS
    records, places = empty(fields.value, stride), empty(capacity, dtype=torch.int32)
    start(
        expand,
        programs(stride, tuning.lanes),
        *(order, ends, boxes, ellipses, looks, N, capacity, stride, N.bit_length(), *grid.place, grid.tiles),
        *(keys, splats, corners, records),
        warps=warps,
        FEATURES=has_features,
        TILE=tuning.tile,
        BLOCK=tuning.lanes,
    )
    sorted_keys, permutation = torch.sort(keys, stable=True)
    begins = torch.searchsorted(sorted_keys, tile_numbers(grid.tiles, key_type, device), out_int32=True)
    start(
        gather,
        programs(capacity, tuning.lanes),
        *(sorted_keys, permutation, begins, splats, corners, ellipses, looks, N, capacity, stride, grid.tiles),
        *(records, places),
        warps=warps,
        FEATURES=has_features,
        CHUNK=tuning.chunk,
        BLOCK=tuning.lanes,
    )
    size = s.height, s.width
    if s.is_whole:
        image, alphas, transmittances = empty(*size, channels), empty(*size), empty(*size)
    else:
        image, alphas = background.repeat(*size, 1), torch.zeros(size, device=device)
        transmittances = torch.ones(size, device=device)
    stops, chunks = empty(*size, dtype=torch.int32), empty(grid.tiles, dtype=torch.int32)
    rest = (background, o.alpha_min, o.alpha_max, o.t_min, N, capacity, stride, s.width, *grid.place, *o.region)
    rest += (image, alphas, transmittances, stops, chunks)
    cut = {"warps": tuning.warps, "TILE": tuning.tile, "CHUNK": tuning.chunk, "STEP": tuning.step}
    if has_features:
        group, number = grouped(channels)
        lists = records, begins, ends, gaussians[4], channels
        start(composite_features, grid.tiles * number, *lists, *rest, GROUP=group, **cut)
    else:
        start(composite, grid.tiles, records, begins, ends, *rest, **cut)
    lists = (order, ends, boxes, begins, records, places)
    drawing = Drawing(tuning, grid, capacity, *lists, transmittances, stops, chunks)
    return Rendering(image, alphas), drawing


def check_counted(what: str, values: int) -> None:
    """Raise CannotDraw where a buffer has more values than the kernels count."""
    if values >= 2**31:
        raise CannotDraw(f"{what} have {values} values in a buffer; a GPU draws with less than 2^31")


def programs(items: int, each: int) -> int:
    """How many programs of `each` items it takes; also what to multiply `each` by to hold all."""
    return -(-items // each)


def grouped(channels: int) -> tuple[int, int]:
    """How many channels of features a program takes, a power of two, and in how many groups."""
    group = 16 if channels <= 16 else 32
    return group, programs(channels, group)


def tile_grid(region: Region, tile: int) -> Grid:
    first_x, first_y = region.left // tile, region.top // tile
    return Grid(first_x, first_y, (region.right - 1) // tile - first_x + 1, (region.bottom - 1) // tile - first_y + 1)


def tile_numbers(tiles: int, dtype: torch.dtype, device: torch.device) -> Int[Tensor, " B"]:
    return _numbers(tiles.bit_length(), dtype, device)[: tiles + 1]


@cache  # for good: a CUDA graph may read them
def _numbers(bits: int, dtype: torch.dtype, device: torch.device) -> Int[Tensor, " P"]:
    return torch.arange(1 << bits, dtype=dtype, device=device)


def needed_pairs(
    gaussians: Gaussians | FeatureGaussians,
    pose: Float[Tensor, " 12"],
    background: Float[Tensor, " C"],
    boxes: Int[Tensor, "4 N"],
    ends: Int[Tensor, " N"],
) -> int:
    """The number of pairs, waited for. Raises CannotDraw, as the "cpu" backend does, where nothing can be drawn."""
    needed = int(ends[-1])
    try:
        check_finite(background=background)
        if needed >= POISON.value:
            check_finite(**gaussians._asdict(), R_cam_world=pose[:9].view(3, 3), t_cam_world=pose[9:])
    except ValueError as error:
        raise CannotDraw(str(error)) from None
    if needed >= POISON.value and bool((spoilt := boxes[3] == POISON.value).any()):
        raise CannotDraw(f"sh gives splat {int(spoilt.nonzero()[0])} a colour beyond the range of float32")
    if needed > MAX_PAIRS:
        raise CannotDraw(
            f"drawing needs {needed} pairs of a tile of {TUNING.tile}x{TUNING.tile} pixels and a splat, the limit is "
            f"{MAX_PAIRS}; are the scales too large for this camera?"
        )
    return needed
