from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from heads import grid_head, random_params
from small_runs import small_config

from avatar.gaussians.latent_grid import latent_grid, uv_charts
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.uv import uv_texels
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.runs.model_registry import make_avatar

RASTER = 32


def grid_of(assets: HeadAssets, cells: int):
    texels = uv_texels(assets, RASTER)
    points = Embedding(assets, texels).points(HeadModel(assets, torch.zeros(0)).neutral_vertices())
    return texels, points, latent_grid(assets, texels, points, cells)


@pytest.mark.parametrize("cells", [1, 2, 5, 16, 32, 100])
def test_a_constant_is_kept_and_every_node_is_used(cells: int) -> None:
    texels, _, grid = grid_of(grid_head(), cells)
    M = len(grid.places)
    assert grid.interpolate.cells.shape == grid.interpolate.weights.shape == (len(texels.row), 4)
    assert (grid.interpolate.weights >= 0).all()
    torch.testing.assert_close(grid.interpolate(torch.full((M, 2), 3.0)), torch.full((len(texels.row), 2), 3.0))
    assert set(grid.interpolate.cells[grid.interpolate.weights > 0].tolist()) == set(range(M))
    assert min(cells, RASTER) ** 2 >= M or cells > RASTER


def test_what_is_linear_over_the_map_is_kept_between_the_outermost_nodes() -> None:
    cells = 8
    texels, _, grid = grid_of(grid_head(), cells)
    u, v = (texels.column + 0.5) / RASTER, (texels.row + 0.5) / RASTER
    # A node's own place in the map, from any Gaussian that takes all or part of it: its cell's centre.
    at = torch.zeros(len(grid.places), 2)
    for corner, (i, j) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        some = grid.interpolate.weights[:, corner] > 0
        low_u = (u * cells - 0.5).clamp(0, cells - 1).floor()
        low_v = (v * cells - 0.5).clamp(0, cells - 1).floor()
        centre = torch.stack((low_u + j + 0.5, low_v + i + 0.5), dim=-1) / cells
        at[grid.interpolate.cells[some, corner]] = centre[some].float()
    inside = (u > 0.5 / cells) & (u < 1 - 0.5 / cells) & (v > 0.5 / cells) & (v < 1 - 0.5 / cells)
    found = grid.interpolate(at)
    expected = torch.stack((u, v), dim=-1).float()
    assert int(inside.sum()) > 500
    torch.testing.assert_close(found[inside], expected[inside], rtol=0, atol=1e-6)


def test_a_grid_as_fine_as_the_raster_is_no_grid() -> None:
    assets = grid_head()
    _, points, grid = grid_of(assets, RASTER)
    torch.testing.assert_close(grid.interpolate(grid.places), points, rtol=0, atol=1e-7)
    assert len(grid.places) == len(points)

    config = small_config("experiment=paper").model
    fine = replace(config, latent_grid=config.uv_size)
    avatars = []
    for model in (config, fine):
        torch.manual_seed(0)
        avatar = make_avatar(assets, torch.zeros(0), model)
        for parameter in avatar.hyper.parameters():
            torch.nn.init.normal_(parameter, std=0.1)
        avatars.append(avatar(random_params()))
    for plain, gridded in zip(*avatars, strict=True):
        torch.testing.assert_close(gridded, plain, rtol=1e-5, atol=1e-6)


def test_charts_are_not_mixed() -> None:
    """A seam down the middle of the map: the same triangles, no shared UV vertex."""
    assets = grid_head(rows=7, columns=9)
    right = assets.uvs[assets.uv_faces][..., 0].mean(dim=1) > 0.5
    faces = assets.uv_faces.clone()
    faces[right] += len(assets.uvs)
    split = replace(assets, uvs=torch.cat((assets.uvs, assets.uvs)), uv_faces=faces)
    assert set(uv_charts(split.uv_faces.numpy(), len(split.uvs))[right.numpy()]).isdisjoint(
        uv_charts(split.uv_faces.numpy(), len(split.uvs))[~right.numpy()]
    )
    texels, _, grid = grid_of(split, 6)
    on_right = right[texels.face]
    left_nodes, right_nodes = (set(grid.interpolate.cells[side].flatten().tolist()) for side in (~on_right, on_right))
    assert left_nodes and right_nodes and left_nodes.isdisjoint(right_nodes)
    values = torch.zeros(len(grid.places), 1)
    values[sorted(right_nodes)] = 1.0
    torch.testing.assert_close(grid.interpolate(values)[:, 0], on_right.float())


def test_places_are_the_weighted_means_of_their_gaussians() -> None:
    _, points, grid = grid_of(grid_head(), 4)
    for node in (0, len(grid.places) // 2, len(grid.places) - 1):
        taken = (grid.interpolate.cells == node).double() * grid.interpolate.weights.double()
        expected = (taken.sum(1)[:, None] * points.double()).sum(0) / taken.sum()
        torch.testing.assert_close(grid.places[node].double(), expected, rtol=0, atol=1e-7)
