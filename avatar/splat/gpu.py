"""Splatting on a GPU by the kernels of `avatar.kernels`, as an autograd function.

A drawing reads nothing back, apart from the first of its kind (see `capacity`). So a value that is not finite, a colour
that overflows or more pairs of tile and splat than there is room for cannot raise: image and alpha are NaN where it draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.check import check_finite
from avatar.kernels.bin import FIELDS, expand, gather
from avatar.kernels.composite import composite
from avatar.kernels.composite_backward import MOMENTS, composite_backward
from avatar.kernels.geometry import VIEW_VALUES
from avatar.kernels.project import POISON, project
from avatar.kernels.project_backward import project_backward
from avatar.kernels.start import start
from avatar.splat.capacity import CAPACITIES, MAX_PAIRS, Kind
from avatar.splat.region import Region
from avatar.types import Camera, Gaussians, Rendering

ALIGNED = 16  # values; what Triton sees of a number that it may load as vectors by


@dataclass(frozen=True)
class Tuning:
    """How the kernels cut their work. Results depend on tile and steps in their last bits only."""

    tile: int = 8  # pixels, width and height; a power of two
    step: int = 8  # splats that are composited at a time
    backward_step: int = 4
    warps: int = 2  # of a tile
    backward_warps: int = 1
    lanes: int = 128  # Gaussians or pairs of a program
    backward_lanes: int = 32

    @property
    def chunk(self) -> int:
        """Records of a tile begin at multiples of it."""
        return max(self.step, self.backward_step)


TUNING = Tuning()


class Settings(NamedTuple):
    """The options of `avatar.splat.splat`, checked, and what they need of the camera."""

    view: Float[Tensor, " 25"]  # float64, see avatar.kernels.geometry
    width: int
    height: int
    region: Region
    sh_degree: int
    alpha_min: float
    alpha_max: float
    t_min: float
    antialiased: bool
    everywhere: bool = False  # for tests: look for every splat at every pixel, as if nothing were known of its extent


class Grid(NamedTuple):
    """The tiles that meet the region. They lie where those of the whole image do, so that a pixel gets the same bits."""

    first_x: int
    first_y: int
    across: int
    down: int

    @property
    def tiles(self) -> int:
        return self.across * self.down


class Drawing(NamedTuple):
    """What the backward pass needs of a forward pass."""

    tuning: Tuning
    grid: Grid
    capacity: int
    order: Int[Tensor, " N"]
    ends: Int[Tensor, " N"]
    boxes: Int[Tensor, "4 N"]
    begins: Int[Tensor, " tiles+1"]
    records: Float[Tensor, "9 stride"]
    places: Int[Tensor, " capacity"]
    transmittances: Float[Tensor, "H W"]
    stops: Int[Tensor, "H W"]
    chunks: Int[Tensor, " tiles"]


class Counted(NamedTuple):
    """What a drawing that counts finds besides."""

    visibility: Int[Tensor, " N"]
    ellipses: Float[Tensor, "5 N"]
    looks: Float[Tensor, "5 N"]
    composited: Int[Tensor, " stride"]


def splat_gpu(gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], **options: Any) -> Rendering:
    """`avatar.splat.splat` without its checks of shape and type; float32 tensors on a GPU."""
    settings = settings_of(camera, gaussians.means.device, **options)
    image, alpha = _Splat.apply(*gaussians, background, settings)  # pyright: ignore
    return Rendering(image, alpha)


def settings_of(
    camera: Camera, device: torch.device, *, blur: float, near: float, region: Region, **options: Any
) -> Settings:
    return Settings(view_block(camera, blur, near, device), camera.width, camera.height, region, **options)


def view_block(camera: Camera, blur: float, near: float, device: torch.device) -> Float[Tensor, " 25"]:
    """What the kernels need of a camera, in the order of `avatar.kernels.geometry`; one asynchronous copy."""
    rotation, translation = camera.R_cam_world.double().flatten().tolist(), camera.t_cam_world.double().tolist()
    slopes: list[float] = []
    for focal, centre, size in ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height)):
        margin = 0.3 * 0.5 * size / focal
        slopes += [-centre / focal - margin, (size - centre) / focal + margin]
    eye = [-sum(rotation[3 * row + column] * translation[row] for row in range(3)) for column in range(3)]
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    values = [*rotation, *translation, *intrinsics, *slopes, *eye, blur, near]
    assert len(values) == VIEW_VALUES
    block = torch.tensor(values, dtype=torch.float64, device="cpu")
    return (block.pin_memory() if device.type == "cuda" else block).to(device, non_blocking=True)


def draw(
    gaussians: Gaussians, background: Float[Tensor, " 3"], settings: Settings, *, count: bool = False
) -> tuple[Rendering, Drawing, Counted]:
    """Draw contiguous tensors of at least one Gaussian; no autograd."""
    means, device, tuning, s = gaussians.means, gaussians.means.device, TUNING, settings
    N, stored = len(means), gaussians.sh.shape[1]
    grid = tile_grid(s.region, tuning.tile)

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    depths, ellipses = empty(N, dtype=torch.float64), empty(5, N, dtype=torch.float64)
    looks, boxes = empty(5, N), empty(4, N, dtype=torch.int32)
    visibility = empty(N, dtype=torch.int8) if count else boxes  # not written without COUNT
    start(
        project,
        -(-N // tuning.lanes),
        *gaussians,
        s.view,
        s.alpha_min,
        s.sh_degree,
        N,
        s.width,
        s.height,
        *grid,
        depths,
        ellipses,
        looks,
        boxes,
        visibility,
        warps=tuning.lanes // 32,
        STORED=stored,
        ANTIALIASED=s.antialiased,
        EVERYWHERE=s.everywhere,
        COUNT=count,
        TILE=tuning.tile,
        BLOCK=tuning.lanes,
    )
    order = torch.sort(depths, stable=True).indices
    ends = boxes[3].index_select(0, order).cumsum(0)
    kind = Kind(device, N, grid.tiles)
    capacity = CAPACITIES.known(kind)
    if capacity is None:
        capacity = CAPACITIES.learn(kind, needed_pairs(gaussians, background, boxes, ends, settings))
    if not 1 <= capacity <= MAX_PAIRS:
        raise ValueError(f"the capacity must be 1 to {MAX_PAIRS} pairs of a tile and a splat, got {capacity}")

    stride = -(-(-(-capacity // tuning.chunk) + grid.tiles) * tuning.chunk // ALIGNED) * ALIGNED
    key_type = torch.int16 if grid.tiles < 2**15 - 1 else torch.int32
    keys, splats, corners = empty(capacity, dtype=key_type), empty(capacity, dtype=torch.int32), empty(2, capacity)
    records, places = empty(FIELDS.value, stride), empty(capacity, dtype=torch.int32)
    place = (grid.first_x, grid.first_y, grid.across)
    start(
        expand,
        -(-stride // tuning.lanes),
        order,
        ends,
        boxes,
        ellipses,
        looks,
        N,
        capacity,
        stride,
        N.bit_length(),
        *place,
        grid.tiles,
        keys,
        splats,
        corners,
        records,
        warps=tuning.lanes // 32,
        TILE=tuning.tile,
        BLOCK=tuning.lanes,
    )
    sorted_keys, permutation = torch.sort(keys, stable=True)
    begins = torch.searchsorted(sorted_keys, tile_numbers(grid.tiles, key_type, device), out_int32=True)
    start(
        gather,
        -(-capacity // tuning.lanes),
        sorted_keys,
        permutation,
        begins,
        splats,
        corners,
        ellipses,
        looks,
        N,
        capacity,
        stride,
        grid.tiles,
        records,
        places,
        warps=tuning.lanes // 32,
        CHUNK=tuning.chunk,
        BLOCK=tuning.lanes,
    )
    size = s.height, s.width
    if s.region == (0, 0, s.width, s.height):
        image, alphas, transmittances = empty(*size, 3), empty(*size), empty(*size)
    else:
        image, alphas = background.repeat(*size, 1), torch.zeros(size, device=device)
        transmittances = torch.ones(size, device=device)
    stops, chunks = empty(*size, dtype=torch.int32), empty(grid.tiles, dtype=torch.int32)
    composited = torch.zeros(stride, dtype=torch.int32, device=device) if count else stops  # not written without COUNT
    start(
        composite,
        grid.tiles,
        records,
        begins,
        ends,
        background,
        s.alpha_min,
        s.alpha_max,
        s.t_min,
        N,
        capacity,
        stride,
        s.width,
        *place,
        *s.region,
        image,
        alphas,
        transmittances,
        stops,
        chunks,
        composited,
        warps=tuning.warps,
        COUNT=count,
        TILE=tuning.tile,
        CHUNK=tuning.chunk,
        STEP=tuning.step,
    )
    CAPACITIES.watch(kind, ends)
    drawing = Drawing(
        tuning, grid, capacity, order, ends, boxes, begins, records, places, transmittances, stops, chunks
    )
    return Rendering(image, alphas), drawing, Counted(visibility, ellipses, looks, composited)


def tile_grid(region: Region, tile: int) -> Grid:
    first_x, first_y = region.left // tile, region.top // tile
    return Grid(first_x, first_y, (region.right - 1) // tile - first_x + 1, (region.bottom - 1) // tile - first_y + 1)


@lru_cache(maxsize=16)
def tile_numbers(tiles: int, dtype: torch.dtype, device: torch.device) -> Int[Tensor, " tiles+1"]:
    return torch.arange(tiles + 1, dtype=dtype, device=device)


def needed_pairs(
    gaussians: Gaussians, background: Tensor, boxes: Int[Tensor, "4 N"], ends: Int[Tensor, " N"], settings: Settings
) -> int:
    """The number of pairs, waited for. Raises ValueError, as the "cpu" backend does, where nothing can be drawn."""
    needed = int(ends[-1])
    check_finite(background=background)
    if needed >= POISON.value:
        check_finite(**gaussians._asdict())
        if bool((spoilt := boxes[3] == POISON.value).any()):
            raise ValueError(f"sh gives splat {int(spoilt.nonzero()[0])} a colour beyond the range of float32")
    if needed > MAX_PAIRS:
        raise ValueError(
            f"drawing needs {needed} pairs of a tile of {TUNING.tile}x{TUNING.tile} pixels and a splat, the limit is "
            f"{MAX_PAIRS}; are the scales too large for this camera?"
        )
    return needed


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        *inputs, background, settings = arguments
        gaussians, background = Gaussians(*(t.detach().contiguous() for t in inputs)), background.detach().contiguous()
        ctx.settings = settings
        ctx.set_materialize_grads(False)
        if len(gaussians.means) == 0:
            ctx.drawing = None
            ctx.save_for_backward(*gaussians, background)
            image = background.repeat(settings.height, settings.width, 1)
            return image, torch.zeros_like(image[..., 0])
        (image, alpha), ctx.drawing, _ = draw(gaussians, background, settings)
        ctx.save_for_backward(*gaussians, background)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None) -> tuple[Tensor | None, ...]:
        *tensors, background = ctx.saved_tensors
        gaussians, settings, drawing = Gaussians(*tensors), ctx.settings, ctx.drawing
        if drawing is None:
            gradients = Gaussians(*(torch.zeros_like(t) for t in gaussians))
            transmittances = torch.ones((), device=background.device)
        else:
            gradients = backward(gaussians, background, settings, drawing, grad_image, grad_alpha)
            transmittances = drawing.transmittances[..., None]
        grad_background = None
        if ctx.needs_input_grad[5]:
            zero = torch.zeros_like(background)
            grad_background = zero if grad_image is None else (grad_image * transmittances).sum((0, 1))
        return *gradients, grad_background, None


def backward(
    gaussians: Gaussians,
    background: Float[Tensor, " 3"],
    settings: Settings,
    drawing: Drawing,
    grad_image: Float[Tensor, "H W 3"] | None,
    grad_alpha: Float[Tensor, "H W"] | None,
) -> Gaussians:
    """The gradients of all fields; two launches."""
    s, d, N, tuning = settings, drawing, len(gaussians.means), drawing.tuning
    stride = d.records.shape[1]
    moments = torch.empty((stride, MOMENTS.value), dtype=torch.float32, device=background.device)
    nothing = moments  # stands for a cotangent that the kernel does not read
    start(
        composite_backward,
        d.grid.tiles,
        d.records,
        d.begins,
        d.chunks,
        background,
        d.transmittances,
        d.stops,
        nothing if grad_image is None else grad_image.contiguous(),
        nothing if grad_alpha is None else grad_alpha.contiguous(),
        s.alpha_min,
        s.alpha_max,
        stride,
        s.width,
        d.grid.first_x,
        d.grid.first_y,
        d.grid.across,
        *s.region,
        moments,
        warps=tuning.backward_warps,
        HAS_IMAGE=grad_image is not None,
        HAS_ALPHA=grad_alpha is not None,
        TILE=tuning.tile,
        CHUNK=tuning.chunk,
        STEP=tuning.backward_step,
        FORWARD_STEP=tuning.step,
    )
    gradients = Gaussians(*(torch.empty_like(t) for t in gaussians))
    start(
        project_backward,
        -(-N // tuning.backward_lanes),
        *gaussians,
        s.view,
        d.order,
        d.ends,
        d.boxes,
        d.places,
        moments,
        s.sh_degree,
        N,
        d.capacity,
        *gradients,
        warps=max(tuning.backward_lanes // 32, 1),
        STORED=gaussians.sh.shape[1],
        ANTIALIASED=s.antialiased,
        BLOCK=tuning.backward_lanes,
    )
    return gradients
