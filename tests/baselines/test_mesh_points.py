"""Points on a mesh: where they are, how they turn, and that walking over an edge leaves them where they were."""

from __future__ import annotations

import math

import pytest
import torch
from heads import grid_head
from kornia.geometry.conversions import quaternion_to_rotation_matrix

from avatar.baselines.mesh_points import MeshPoints, frame_quats
from avatar.head.normals import vertex_normals

SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
HALVES = torch.tensor([[0, 1, 2], [2, 3, 0]])


def in_square(places: list[list[float]], faces: torch.Tensor = HALVES) -> MeshPoints:
    """Points of the first triangle at these places of its plane, which is that of the square."""
    count = len(places)
    first = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).repeat(count, 1)
    points = MeshPoints(count, learned=True).double().bind(faces, SQUARE, torch.zeros(count, dtype=torch.long), first)
    with torch.no_grad():
        points.place[:, :2] = torch.tensor(places, dtype=torch.float64)
    return points


def head_points(count: int = 200, seed: int = 0) -> tuple[MeshPoints, torch.Tensor]:
    """Points at random places of a head; and its neutral vertices."""
    assets, generator = grid_head(), torch.Generator().manual_seed(seed)
    vertices = assets.template.double()
    face = torch.randint(0, len(assets.faces), (count,), generator=generator)
    weights = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    points = MeshPoints(count, learned=True).double()
    return points.bind(assets.faces, vertices, face, weights / weights.sum(1, keepdim=True)), vertices


def test_a_point_is_where_its_barycentric_coordinates_say_and_above_it() -> None:
    points, vertices = head_points()
    with torch.no_grad():
        points.place[:, 2] = torch.linspace(-0.01, 0.01, len(points.place))
    faces = grid_head().faces
    corners, weights = faces[points.face], points.barycentric().detach()
    assert bool((weights >= 0).all()) and torch.allclose(weights.sum(1), torch.ones_like(weights[:, 0]))
    normals = torch.nn.functional.normalize(
        (vertex_normals(vertices, faces)[corners] * weights[..., None]).sum(1), dim=-1
    )
    expected = (vertices[corners] * weights[..., None]).sum(1) + points.place[:, 2:].detach() * normals
    torch.testing.assert_close(points.points(vertices).detach(), expected)
    # A rigid motion of the mesh is one of the points, and turns them all by the same rotation.
    angle = 0.7
    turn = torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0], dtype=torch.float64)
    R, shift = quaternion_to_rotation_matrix(turn), torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    torch.testing.assert_close(points.points(vertices @ R.T + shift).detach(), expected @ R.T + shift)
    turns = points.turns(vertices @ R.T + shift)
    torch.testing.assert_close((turns * turn).sum(1).abs(), torch.ones(len(turns), dtype=torch.float64))
    still = points.turns(vertices)
    torch.testing.assert_close(still[:, 0].abs(), torch.ones(len(turns), dtype=torch.float64))


def test_normals_point_out_of_a_head_and_are_those_of_a_plane() -> None:
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(vertex_normals(SQUARE, HALVES), up.expand(4, 3))
    assert frame_quats(SQUARE[HALVES[:1]]).tolist() == [[1.0, 0.0, 0.0, 0.0]]


@pytest.mark.parametrize("faces", [HALVES, torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.tensor([[0, 1, 2], [3, 0, 2]])])
def test_over_an_edge_a_place_stays_where_it_is(faces: torch.Tensor) -> None:
    """In whichever corner the neighbour begins."""
    inside, beyond = [0.6, 0.2], [0.3, 0.7]
    points = in_square([inside, beyond], faces)
    before = points.points(SQUARE).detach()
    momentum = torch.tensor([[1.0, 2.0, 3.0]] * 2, dtype=torch.float64)
    assert points.walk([momentum]) == 1
    assert points.face.tolist() == [0, 1] and bool((points.barycentric() >= 0).all())
    after = points.points(SQUARE).detach()
    torch.testing.assert_close(after[:, :2], before[:, :2])
    torch.testing.assert_close(after[1, :2], torch.tensor(beyond, dtype=torch.float64))
    # A step along the momentum goes the same way in space as before.
    assert momentum[0].tolist() == [1.0, 2.0, 3.0] and momentum[1, 2] == 3.0
    with torch.no_grad():
        points.place[1, :2] += 1e-3 * momentum[1, :2]
    moved = (points.points(SQUARE).detach() - after)[1, :2]
    torch.testing.assert_close(moved, 1e-3 * torch.tensor([1.0, 2.0], dtype=torch.float64))
    assert points.walk() == 0


@pytest.mark.parametrize("faces", [HALVES, torch.tensor([[0, 1, 2], [3, 2, 0][::-1]])])
def test_nothing_goes_over_the_rim(faces: torch.Tensor) -> None:
    """Nor over an edge beyond which the surface is turned inside out."""
    points = in_square([[0.5, -0.3], [1.4, 0.5], [2.0, -1.0], [-0.5, 1.5]], faces)
    assert points.walk() == 4
    found = points.points(SQUARE).detach()
    assert bool((points.barycentric() >= -1e-12).all())
    assert bool(((found[:, :2] >= -1e-9) & (found[:, :2] <= 1 + 1e-9)).all())
    assert found[0, 1] == 0.0 and float(found[1, 0]) == pytest.approx(1.0)


def test_on_a_head_a_walk_ends_inside_a_triangle_near_where_it_led() -> None:
    points, vertices = head_points(500)
    before = points.points(vertices).detach()
    step = 0.006 * torch.nn.functional.normalize(
        torch.randn(500, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64), dim=1
    )
    with torch.no_grad():
        points.place[:, :2] += step
    old = points.face.clone()
    assert 0 < points.walk() < 500
    assert int((points.face != old).sum()) > 50 and bool((points.barycentric() >= -1e-9).all())
    # The way over the surface is as long as the step; the straight line is not longer.
    gone = (points.points(vertices).detach() - before).norm(dim=1)
    assert float(gone.max()) <= 0.006 + 1e-9 and float(gone.median()) > 0.005


def test_gradients_reach_places_and_vertices() -> None:
    points, vertices = head_points(4)
    with torch.no_grad():
        points.place[:, 2] = 0.003
    place = points.place.detach().clone().requires_grad_()

    def posed(place: torch.Tensor, vertices: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(points, {"place": place}, (vertices,))

    points.forward = points.points  # type: ignore[method-assign]
    assert torch.autograd.gradcheck(posed, (place, vertices.clone().requires_grad_()), eps=1e-7, atol=1e-5)


def test_a_triangle_that_there_is_not_is_refused() -> None:
    points, _ = head_points(3)
    points.check()
    points.face[1] = 10**6
    with pytest.raises(ValueError, match="points on triangles that its head model of .* does not have"):
        points.check()
