"""A surface fitted to pictures of a sphere, and what the fit is made of."""

from __future__ import annotations

import math

import pytest
import torch
from heads import grid_head, rest_params
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch.nn.functional import cosine_similarity, normalize

from avatar.data.frame import Frame
from avatar.gaussianheadavatar import initial_surface
from avatar.gaussianheadavatar.initial_surface import (
    at_places,
    fit_surface,
    flat_gaussians,
    laplacian,
    signed_distances,
    small_view,
)
from avatar.gaussianheadavatar.marching_tetrahedra import Grid, marching_tetrahedra
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.uv import bound_texels
from avatar.head.model import HeadModel
from avatar.types import Camera

SIZE, RADIUS, SHIFT = 64, 0.06, torch.tensor([0.0, 0.02, 0.0])
GRID = Grid(torch.full((3,), -0.1), 0.01, (21, 21, 21))


def camera_at(angle: float) -> Camera:
    """It looks at the origin from 0.6 m, `angle` radians around the y axis."""
    c, s = math.cos(angle), math.sin(angle)
    R = torch.diag(torch.tensor([1.0, -1.0, -1.0])) @ torch.tensor([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    return Camera(R, torch.tensor([0.0, 0.0, 0.6]), 200.0, 200.0, SIZE / 2, SIZE / 2, SIZE, SIZE)


def picture(index: int, camera: Camera, centre: torch.Tensor) -> Frame:
    """A brown sphere before green, with its matte."""
    steps = torch.arange(SIZE) + 0.5 - SIZE / 2
    y, x = torch.meshgrid(steps / camera.fy, steps / camera.fx, indexing="ij")
    rays = normalize(torch.stack((x, y, torch.ones_like(x)), dim=-1), dim=-1)
    seen = camera.R_cam_world @ centre + camera.t_cam_world
    alpha = ((seen - (rays @ seen)[..., None] * rays).norm(dim=-1) <= RADIUS).float()
    image = torch.lerp(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.5, 0.3, 0.2]), alpha[..., None])
    whole = torch.ones_like(alpha)
    return Frame(index, str(index), camera, rest_params(), image, alpha, whole, whole)


def test_the_surface_of_a_cube_becomes_the_sphere_that_moves_with_the_mesh_in_pictures(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Every second frame the mesh, and with it the sphere, is 2 cm higher.
    def motion(self: object, heads: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        return (heads % 2)[:, None] * SHIFT

    monkeypatch.setattr(initial_surface.MeshMotion, "__call__", motion)
    monkeypatch.setattr(initial_surface, "STEPS", 200)
    frames = [picture(i, camera_at(0.7 * (i // 2)), (i % 2) * SHIFT) for i in range(18)]
    assets = grid_head()
    mesh = Embedding(assets, bound_texels(assets, assets, 8, 1))
    cube = (GRID.points().abs() < 0.9 * RADIUS).all(dim=1).reshape(GRID.shape)
    found = fit_surface(cube, GRID, HeadModel(assets, torch.zeros(3)), mesh, frames)
    started = marching_tetrahedra(signed_distances(cube), GRID.tetrahedra()).of(GRID.points())
    before, after = ((points.norm(dim=1) - RADIUS).abs().mean() for points in (started, found))
    assert float(before) > 0.01 and float(after) < 0.005
    assert float(found[:, 1].mean().abs()) < 0.003  # as high as without the mesh's motion


def test_a_surface_of_nothing_is_refused() -> None:
    assets = grid_head()
    mesh = Embedding(assets, bound_texels(assets, assets, 8, 1))
    nothing = torch.zeros(GRID.shape, dtype=torch.bool)
    with pytest.raises(ValueError, match="shrunk to nothing"):
        fit_surface(nothing, GRID, HeadModel(assets, torch.zeros(3)), mesh, [picture(0, camera_at(0.0), SHIFT)])


def test_distances_are_negative_inside_and_change_by_one_cell_at_the_boundary() -> None:
    inside = torch.zeros(5, 5, 7, dtype=torch.bool)
    inside[1:4, 1:4, 1:6] = True
    along = signed_distances(inside).reshape(5, 5, 7)[2, 2]
    assert along.tolist() == [1.0, -1.0, -2.0, -2.0, -2.0, -1.0, 1.0]


def test_a_triangles_gaussian_lies_in_it_and_one_without_area_is_finite() -> None:
    points = torch.randn(30, 3, requires_grad=True)
    faces = torch.cat((torch.randint(30, (40, 3)), torch.tensor([[0, 0, 1], [2, 2, 2]])))
    colours = torch.rand(30, 3)
    gaussians = flat_gaussians(points, faces, colours)
    corners = points[faces]
    torch.testing.assert_close(gaussians.means, corners.mean(dim=1))
    torch.testing.assert_close(gaussians.features, torch.cat((colours[faces].mean(dim=1), torch.ones(42, 1)), dim=1))
    assert all(bool(torch.isfinite(field).all()) for field in gaussians)
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    has_area = normals.norm(dim=1) > 1e-3
    thin = quaternion_to_rotation_matrix(gaussians.quats)[:, :, 2]
    torch.testing.assert_close(
        cosine_similarity(thin, normals, dim=1).abs()[has_area], torch.ones(int(has_area.sum())), rtol=0, atol=1e-4
    )
    assert bool((gaussians.scales[has_area, 2] < 0.2 * gaussians.scales[has_area, 0]).all())


def test_the_laplacian_leads_to_the_mean_of_the_neighbours() -> None:
    surface = marching_tetrahedra(torch.tensor([-1.0, 1.0, 1.0, 1.0, 1.0]), torch.tensor([[0, 1, 2, 3], [0, 2, 3, 4]]))
    points = torch.randn(len(surface.edges), 3)
    expected = [
        points[[j for j in range(4) if j != i and any({i, j} <= set(face) for face in surface.faces.tolist())]]
        for i in range(4)
    ]
    shared = surface.faces.flatten().bincount() == 2  # such neighbours are counted once for each of two triangles
    found = laplacian(points, surface)
    for i in (~shared).nonzero()[:, 0].tolist():
        torch.testing.assert_close(found[i], expected[i].mean(dim=0) - points[i])


def test_values_between_grid_points_are_linear_and_beyond_the_grid_those_of_its_border() -> None:
    grid = Grid(torch.tensor([-0.3, 0.1, 0.2]), 0.1, (4, 6, 5))
    slope = torch.tensor([2.0, -3.0, 5.0])
    volume = (grid.points() @ slope).reshape(grid.shape)
    high = grid.low + 0.1 * (torch.tensor(grid.shape) - 1)
    places = torch.lerp(grid.low, high, torch.rand(20, 3))
    torch.testing.assert_close(at_places(volume, grid, places), places @ slope, rtol=0, atol=1e-5)
    beyond = high + torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(at_places(volume, grid, beyond[None])[0], high @ slope, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("side", "small"), [(64, 64), (600, 300), (1023, 255)])
def test_a_large_frame_is_made_smaller_with_its_camera(side: int, small: int) -> None:
    whole = torch.ones(side, side // 2)
    frame = Frame(0, "0", camera_at(0.0).resized(side // 2, side), rest_params(), torch.zeros(side, side // 2, 3),
                  0.25 * whole, whole, whole)  # fmt: skip
    camera, target = small_view(frame)
    assert (camera.width, camera.height) == (small // 2, small) and target.shape == (small, small // 2, 4)
    torch.testing.assert_close(target, torch.tensor([0.75, 0.75, 0.75, 0.25]).expand_as(target))
    places = camera.project(torch.zeros(3)), frame.camera.project(torch.zeros(3))
    torch.testing.assert_close(places[0][1] / small, places[1][1] / side)
