"""Surfaces of spheres on a grid of tetrahedra."""

from __future__ import annotations

import math

import pytest
import torch

from avatar.gaussianheadavatar.marching_tetrahedra import Grid, Surface, marching_tetrahedra

GRID = Grid(torch.tensor([-0.5, -0.4, -0.45]), 0.05, (21, 18, 19))
CENTRE, RADIUS = torch.tensor([0.013, 0.021, -0.008]), 0.31


def sphere(sign: float = 1.0) -> Surface:
    values = sign * ((GRID.points() - CENTRE).norm(dim=1) - RADIUS)
    return marching_tetrahedra(values, GRID.tetrahedra())


def test_tetrahedra_fill_the_grid_and_have_equal_volumes() -> None:
    corners = GRID.points()[GRID.tetrahedra()]
    volumes = torch.linalg.det(corners[:, 1:] - corners[:, :1]).abs() / 6.0
    cubes = 20 * 17 * 18
    assert len(corners) == 6 * cubes
    torch.testing.assert_close(volumes, torch.full((6 * cubes,), 0.05**3 / 6.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_surface_of_a_sphere_is_closed_and_has_its_radius_and_area(sign: float) -> None:
    surface = sphere(sign)
    points = surface.of(GRID.points())
    torch.testing.assert_close((points - CENTRE).norm(dim=1), torch.full((len(points),), RADIUS), rtol=0, atol=0.004)
    sides = surface.faces[:, [[0, 1], [1, 2], [2, 0]]].sort(dim=-1).values.reshape(-1, 2)
    sides, uses = sides.unique(dim=0, return_counts=True)
    assert bool((uses == 2).all())
    assert len(points) - len(sides) + len(surface.faces) == 2  # Euler's formula: one sphere, no holes
    corners = points[surface.faces]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1) / 2.0
    assert float(areas.sum()) == pytest.approx(4.0 * math.pi * RADIUS**2, rel=0.02)


def test_the_gradient_of_the_surface_is_that_of_its_formula() -> None:
    grid = Grid(torch.zeros(3), 1.0, (3, 3, 3))
    values = torch.linspace(-1.0, 1.3, 27, dtype=torch.float64).roll(5).requires_grad_()
    tets = grid.tetrahedra()
    assert torch.autograd.gradcheck(
        lambda v: marching_tetrahedra(v, tets).of(grid.points().double()), values, eps=1e-7, atol=1e-6
    )


def test_where_no_value_changes_its_sign_there_is_no_surface() -> None:
    surface = marching_tetrahedra(torch.ones(21 * 18 * 19), GRID.tetrahedra())
    assert surface.of(GRID.points()).shape == (0, 3) and surface.faces.shape == (0, 3)
