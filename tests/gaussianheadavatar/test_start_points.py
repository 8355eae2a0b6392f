"""The hull of a sphere that cameras all around see, and subsets of points."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import normalize

from avatar.gaussianheadavatar import start_points
from avatar.gaussianheadavatar.marching_tetrahedra import Grid
from avatar.gaussianheadavatar.start_points import (
    knn_log_scales,
    landmarks,
    mouth_box,
    share_inside,
    spread_points,
    visual_hull,
)
from avatar.types import Camera

CENTRE = torch.tensor([0.01, -0.02, 0.015])
RADIUS, SIZE = 0.1, 160
GRID = Grid(torch.full((3,), -0.155), 0.01, (32, 32, 35))
Views = list[tuple[Camera, torch.Tensor]]


def all_around(count: int) -> torch.Tensor:
    """Directions on a spiral over the sphere."""
    k = torch.arange(count)
    z, turn = 1 - (2 * k + 1) / count, math.pi * (3 - math.sqrt(5)) * k
    ring = (1 - z * z).sqrt()
    return torch.stack((ring * turn.cos(), ring * turn.sin(), z), dim=1)


def camera_at(place: torch.Tensor) -> Camera:
    """It looks at the origin."""
    forward = normalize(-place, dim=0)
    right = normalize(torch.linalg.cross(forward, torch.tensor([0.3, 1.0, 0.1])), dim=0)
    R = torch.stack((right, torch.linalg.cross(forward, right), forward))
    return Camera(R, -R @ place, 260.0, 260.0, SIZE / 2, SIZE / 2, SIZE, SIZE)


def sees(camera: Camera) -> torch.Tensor:
    """The mask of the sphere: the rays that pass its centre within its radius."""
    pixels = torch.arange(SIZE) + 0.5
    y, x = torch.meshgrid((pixels - camera.cy) / camera.fy, (pixels - camera.cx) / camera.fx, indexing="ij")
    rays = normalize(torch.stack((x, y, torch.ones_like(x)), dim=-1), dim=-1)
    centre = camera.R_cam_world @ CENTRE + camera.t_cam_world
    return ((centre - (rays @ centre)[..., None] * rays).norm(dim=-1) <= RADIUS).float()


def sphere_views(count: int = 12) -> Views:
    cameras = [camera_at(0.8 * direction) for direction in all_around(count)]
    return [(camera, sees(camera)) for camera in cameras]


def hull_of(views: Views) -> torch.Tensor:
    return visual_hull(share_inside(views, GRID), GRID)


def distances(vertices: torch.Tensor) -> torch.Tensor:
    return (vertices - CENTRE).norm(dim=1)


@pytest.mark.parametrize("agree", [0.95, 0.9])
def test_the_hull_of_a_sphere_is_the_sphere(agree: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start_points, "AGREE", agree)
    vertices = hull_of(sphere_views())
    found = distances(vertices)
    assert float(found.min()) > RADIUS - GRID.cell and float(found.max()) < RADIUS + GRID.cell
    directions = normalize(vertices - CENTRE, dim=1)
    assert float((all_around(100) @ directions.T).amax(dim=1).min()) > 0.98  # it is there all around


def test_a_wrong_mask_is_outvoted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start_points, "AGREE", 0.8)
    views = sphere_views()
    right = distances(hull_of(views))
    views[4] = views[4][0], torch.zeros(SIZE, SIZE)
    wrong = distances(hull_of(views))
    assert float(wrong.min()) > RADIUS - GRID.cell and float(wrong.max()) < RADIUS + 2 * GRID.cell
    assert abs(float(wrong.mean() - right.mean())) < 0.5 * GRID.cell
    monkeypatch.setattr(start_points, "AGREE", 0.999)
    with pytest.raises(ValueError, match="100% of the views"):
        share_inside(views, GRID)


def test_views_that_do_not_see_a_place_do_not_vote() -> None:
    views = sphere_views()
    away = camera_at(torch.tensor([0.0, 0.0, -0.8]))
    behind = Camera(away.R_cam_world, torch.tensor([0.0, 0.0, -0.8]), 260.0, 260.0, 80.0, 80.0, SIZE, SIZE)
    expected = share_inside(views, GRID)
    assert torch.equal(share_inside([*views, (behind, torch.zeros(SIZE, SIZE))], GRID), expected)
    with pytest.raises(ValueError, match="no place in the box"):
        share_inside([(behind, torch.ones(SIZE, SIZE))], GRID)


def test_a_mask_may_have_another_size_than_the_camera() -> None:
    views = [(camera.resized(2 * SIZE, 2 * SIZE), mask) for camera, mask in sphere_views()]
    torch.testing.assert_close(share_inside(views, GRID), share_inside(sphere_views(), GRID))


def test_a_grid_that_the_masks_fill_is_the_hull_but_for_its_border() -> None:
    views = [(camera, torch.ones(SIZE, SIZE)) for camera, _ in sphere_views()]
    grid = Grid(torch.full((3,), -0.04), 0.01, (9, 8, 7))
    share = share_inside(views, grid)
    assert bool((share[1:-1, 1:-1, 1:-1] == 1.0).all()) and float(share.sum()) == 7 * 6 * 5
    vertices = visual_hull(share, grid)
    torch.testing.assert_close(vertices.amin(dim=0), grid.low + 0.009, rtol=0, atol=1e-6)
    torch.testing.assert_close(vertices.amax(dim=0), grid.low + torch.tensor([0.071, 0.061, 0.051]), rtol=0, atol=1e-6)


def test_without_masks_there_is_no_visual_hull() -> None:
    views = [(camera, torch.zeros_like(mask)) for camera, mask in sphere_views()]
    with pytest.raises(ValueError, match="no place in the box lies in the masks of 90% of the views"):
        share_inside(views, GRID)


@pytest.mark.parametrize("count", [1, 7, 500, 4999, 5000])
def test_a_subset_is_spread_evenly(count: int) -> None:
    points = normalize(torch.randn(5000, 3), dim=1)
    chosen = spread_points(points, count)
    assert chosen.shape == (count, 3) and torch.equal(chosen, spread_points(points, count))
    nearest = torch.cdist(chosen, points, compute_mode="donot_use_mm_for_euclid_dist").min(dim=1)
    assert not bool(nearest.values.any()) and len(nearest.indices.unique()) == count
    if count == 500:
        spacing = math.sqrt(4 * math.pi / count)
        assert float(torch.cdist(points, chosen).amin(dim=1).max()) < 2 * spacing


def test_more_points_than_there_are_lie_beside_them() -> None:
    points = torch.randn(10, 3)
    chosen = spread_points(points, 34)
    assert torch.equal(chosen[:10], points) and len(chosen.unique(dim=0)) == 34
    extent = float((points.amax(dim=0) - points.amin(dim=0)).max())
    away = (chosen[10:] - points.repeat(3, 1)[:24]).abs()
    assert 0 < float(away.max()) <= 0.5e-3 * extent


def test_points_that_coincide_can_be_chosen_from() -> None:
    assert torch.equal(spread_points(torch.ones(9, 3), 4), torch.ones(4, 3))


def test_points_of_the_mouth_lie_in_its_box() -> None:
    lips = torch.rand(30, 3) * torch.tensor([0.06, 0.02, 0.01]) + torch.tensor([0.1, -0.2, 0.3])
    points = mouth_box(lips, 4000, torch.Generator().manual_seed(1))
    low, high = lips.amin(dim=0), lips.amax(dim=0)
    centre = torch.stack(((low + high)[0] / 2, (low + high)[1] / 2, low[2]))
    reach = ((points - centre) / (high - low)).abs().amax(dim=0)
    assert bool((reach <= 0.8 + 1e-4).all()) and bool((reach > 0.79).all())
    torch.testing.assert_close(points.mean(dim=0), centre, rtol=0, atol=2e-3)
    assert torch.equal(points, mouth_box(lips, 4000, torch.Generator().manual_seed(1)))


def test_landmarks_are_vertices_of_the_face() -> None:
    vertices, face = torch.randn(300, 3), torch.arange(100, 200)
    chosen = landmarks(vertices, face, 40)
    assert chosen.shape == (40, 3)
    assert bool((chosen[:, None] == vertices[face]).all(dim=-1).any(dim=1).all())


def test_first_sizes_are_those_to_the_next_points() -> None:
    points = torch.rand(50, 3)
    nearest = torch.cdist(points.double(), points.double()).topk(4, largest=False).values[:, 1:]
    expected = nearest.square().mean(dim=1).sqrt().log().float()
    torch.testing.assert_close(knn_log_scales(points), expected[:, None].expand(-1, 3))
