"""The head's surface, fitted to training pictures before training.

    signed distances on a grid -> marching tetrahedra -> triangles, moved with the mesh -> flat Gaussians -> picture

In the first stage of Gaussian Head Avatar (CVPR 2024) networks give distances and colours, and a rasterizer draws the
triangles. Here both are values at the grid's points, and a flat Gaussian is splatted for each triangle.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, normalize
from tqdm import tqdm

from avatar.data.frame import Frame
from avatar.gaussianheadavatar.initial_motion import MeshMotion
from avatar.gaussianheadavatar.marching_tetrahedra import Grid, Surface, marching_tetrahedra
from avatar.gaussians.mesh_embedding import Embedding
from avatar.head.model import HeadModel
from avatar.splat import splat_features
from avatar.tensors import take_rows
from avatar.types import Camera, FeatureGaussians

STEPS = 400
SIDE = 256  # pixels, which larger pictures are brought near by a whole factor
BAND = 4.0  # cells from the hull, as far as the surface can move
RATE = 0.1  # Adam's at the start, of distances (cells) and of colours; it decays along half a cosine
OUTLINE, SMOOTH, ON_MESH = 0.3, 0.01, 0.001  # weights beside the colour's
FAR = 3.0  # cells from which on a point of the mesh counts no more
OPACITY, WIDTH, DEPTH = 0.99, 0.6, 0.06  # of a triangle's Gaussian; standard deviations, of the root of its area
BLUR = 0.1  # pixels^2


def fit_surface(
    hull: Bool[Tensor, "X Y Z"], grid: Grid, head: HeadModel, mesh: Embedding, frames: Sequence[Frame]
) -> Float[Tensor, "M 3"]:
    """Points of the surface that looks as the frames do, head at rest, metres; it starts at the boundary of `hull`.

    Loss: L1 of the picture over white, 0.3 (1 - IoU) of the outline, 0.01 of squared uniform Laplacians and 0.001 of
    the mesh's distances to the surface, both in cells. Raises ValueError where nothing is left.
    """
    start = signed_distances(hull)
    tets = grid.tetrahedra()
    tets = tets[(start.abs() <= BAND)[tets].all(dim=1)]
    places = grid.points()
    motion = MeshMotion(head, mesh, places, [frame.params for frame in frames])
    views = [small_view(frame) for frame in frames]
    on_mesh = mesh.points(head.neutral_vertices())
    distances, colours = start.clone().requires_grad_(), torch.full((len(start), 3), 0.5, requires_grad=True)
    optimizer = torch.optim.Adam([distances, colours], RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    generator = torch.Generator().manual_seed(0)
    for _ in tqdm(range(STEPS), desc="surface", unit="step", dynamic_ncols=True, leave=False):
        chosen = int(torch.randint(len(frames), (), generator=generator))
        with torch.enable_grad():
            surface = marching_tetrahedra(distances, tets)
            if not len(surface.faces):
                raise ValueError("the surface that the pictures show has shrunk to nothing")
            points = surface.of(places)
            head_of_each = torch.full((len(points),), chosen)
            moved = points + motion(head_of_each, surface.edges[:, 0])
            shown = surface._replace(shares=surface.shares.detach()).of(colours)
            loss = picture_loss(flat_gaussians(moved, surface.faces, shown), *views[chosen])
            loss = loss + SMOOTH * (laplacian(points, surface) / grid.cell).square().sum(dim=1).mean()
            to_mesh = at_places(distances.reshape(grid.shape), grid, on_mesh)
            loss = loss + ON_MESH * to_mesh.abs().clamp(max=FAR).mean()
            optimizer.zero_grad()
            loss.backward()
        optimizer.step()
        schedule.step()
    return marching_tetrahedra(distances.detach(), tets).of(places)


def signed_distances(inside: Bool[Tensor, "X Y Z"]) -> Float[Tensor, " P"]:
    """From each point to the nearest one of the other side, in cells; negative inside."""
    outwards, inwards = (torch.tensor(distance_transform_edt(side.numpy())) for side in (~inside, inside))
    return (outwards - inwards).float().flatten()


def small_view(frame: Frame) -> tuple[Camera, Float[Tensor, "H W 4"]]:
    """The frame over white with its matte as a fourth channel; the longer side is below 384 pixels."""
    matte = (frame.alpha * frame.head_mask)[..., None]
    target = torch.cat((frame.composite(frame.image.new_ones(3)), matte), dim=-1)
    height, width = target.shape[:2]
    factor = max(1, round(max(height, width) / SIDE))
    size = max(1, height // factor), max(1, width // factor)
    small = interpolate(target.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)
    return frame.camera.resized(size[1], size[0]), small


def flat_gaussians(
    points: Float[Tensor, "E 3"], faces: Int[Tensor, "F 3"], colours: Float[Tensor, "E 3"]
) -> FeatureGaussians:
    """One for each triangle, differentiable in its place and its colour, with the matte as a fourth channel."""
    corners = take_rows(points, faces)
    with torch.no_grad():
        cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = normalize(cross, dim=1)
        normal = torch.where(normal[:, 2:] < 0, -normal, normal)
        x, y, z = normal.unbind(1)
        quats = normalize(torch.stack((1.0 + z, -y, x, torch.zeros_like(z)), dim=1), dim=1)  # from the z axis to it
        size = (0.5 * cross.norm(dim=1)).sqrt()[:, None]
        scales = (size * size.new_tensor([WIDTH, WIDTH, DEPTH])).clamp(min=1e-5)
    features = torch.cat((take_rows(colours, faces).mean(dim=1), colours.new_ones(len(faces), 1)), dim=1)
    return FeatureGaussians(corners.mean(dim=1), quats, scales, colours.new_full((len(faces),), OPACITY), features)


def picture_loss(gaussians: FeatureGaussians, camera: Camera, target: Float[Tensor, "H W 4"]) -> Float[Tensor, ""]:
    background = target.new_tensor([1.0, 1.0, 1.0, 0.0])
    image = splat_features(*gaussians, camera, background, blur=BLUR).image
    drawn, matte = image[..., 3], target[..., 3]
    both = (drawn * matte).sum()
    outline = 1.0 - both / (drawn.sum() + matte.sum() - both).clamp(min=1.0)
    return (image[..., :3] - target[..., :3]).abs().mean() + OUTLINE * outline


def laplacian(points: Float[Tensor, "E 3"], surface: Surface) -> Float[Tensor, "E 3"]:
    """From each point to the mean of its neighbours."""
    corners = surface.faces.flatten()
    of_faces = take_rows(points, surface.faces)
    others = of_faces.sum(dim=1, keepdim=True) - of_faces
    sums = torch.zeros_like(points).index_add(0, corners, others.reshape(-1, 3))
    counts = 2.0 * torch.bincount(corners, minlength=len(points))
    return sums / counts[:, None] - points


def at_places(volume: Float[Tensor, "X Y Z"], grid: Grid, places: Float[Tensor, "M 3"]) -> Float[Tensor, " M"]:
    """The volume's values, linear in between; beyond the grid those at its border."""
    last = torch.tensor(grid.shape) - 1.0
    where = (2.0 * (places - grid.low) / (grid.cell * last) - 1.0).flip(-1)
    options = {"align_corners": True, "padding_mode": "border"}
    return grid_sample(volume[None, None], where[None, None, None], **options).flatten()
