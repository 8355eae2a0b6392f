from __future__ import annotations

import numpy as np
import pytest
import torch
from heads import grid_head, random_params

from avatar.errors import UserError
from avatar.gaussians.mesh_embedding import Embedding, knn_scales
from avatar.gaussians.uv import detailed_faces, painted, uv_texels
from avatar.head.model import HeadModel


def test_each_texel_lies_where_its_centre_lies_in_the_uv_map() -> None:
    assets, size = grid_head(), 32
    texels = uv_texels(assets, size)
    corners = assets.uvs[assets.uv_faces[texels.face]]
    uv = (corners * texels.barycentric[:, :, None]).sum(1)
    torch.testing.assert_close(uv[:, 0] * size, texels.column + 0.5, rtol=0, atol=1e-4)
    torch.testing.assert_close((1 - uv[:, 1]) * size, texels.row + 0.5, rtol=0, atol=1e-4)


def test_all_texels_of_the_map_are_covered_except_the_boundarys() -> None:
    assets, size = grid_head(rows=7, columns=9), 64
    texels = uv_texels(assets, size)
    # The map covers u, v in [0.05, 0.95]; the boundary is the lowest of six rows of quads.
    centres = (np.arange(size) + 0.5) / size
    columns = ((centres > 0.05) & (centres < 0.95)).sum()
    rows = ((1 - centres > 0.05 + 0.9 / 6) & (1 - centres < 0.95)).sum()
    assert len(texels.row) == rows * columns
    assert not np.isin(assets.faces[texels.face], assets.regions["boundary"]).any()


def test_detail_makes_the_raster_finer_about_the_lips_and_nowhere_else() -> None:
    assets = grid_head(rows=31, columns=41)  # vertices 5 and 6.7 mm apart
    plain, fine, both = uv_texels(assets, 40), uv_texels(assets, 120), uv_texels(assets, 40, detail=3)
    near = detailed_faces(assets)
    lips = assets.template[assets.regions["lips"]]
    reach = torch.cdist(assets.template, lips).amin(dim=1)[assets.faces].amax(dim=1)
    assert bool(near[reach < 0.0119].all()) and not bool(near[reach > 0.0121].any())
    assert 0 < int(near.sum()) < len(near)
    is_fine = both.side == 120
    assert set(both.side.tolist()) == {40, 120} and torch.equal(is_fine, near[both.face])
    for part, whole, inside in ((~is_fine, plain, ~near), (is_fine, fine, near)):
        kept = inside[whole.face]
        assert int(kept.sum()) == int(part.sum()) > 0
        assert all(torch.equal(a[part], b[kept]) for a, b in zip(both, whole, strict=True))


def test_a_detailed_map_is_painted_on_the_finer_raster() -> None:
    assets = grid_head(rows=31, columns=41)
    both = uv_texels(assets, 32, detail=2)
    image, covered = painted(both, both.face[:, None].numpy())
    fine = uv_texels(assets, 64)
    assert covered.shape == (64, 64) and covered[fine.row, fine.column].mean() > 0.9
    inside = both.side == 64
    assert np.array_equal(image[both.row[inside], both.column[inside], 0], both.face[inside].numpy())
    corner = both.row[~inside] * 2 + 1, both.column[~inside] * 2 + 1
    assert (image[corner][:, 0] == both.face[~inside].numpy()).mean() > 0.9  # but where a fine texel lies over it
    assert not covered[0].any() and not image[~covered].any()


def test_detail_needs_room() -> None:
    assets = grid_head()
    with pytest.raises(
        UserError, match=r"model\.uv_size=1024 times model\.uv_detail=4 is 4096 texels a side: at most 2048"
    ):
        uv_texels(assets, 1024, detail=4)


def test_points_follow_the_mesh() -> None:
    assets = grid_head()
    embedding = Embedding(assets, uv_texels(assets, 24))
    vertices = HeadModel(assets, torch.randn(10)).vertices(random_params())
    points = embedding.points(vertices)
    for index in (0, len(embedding) // 2, len(embedding) - 1):
        face = assets.faces[embedding.texels.face[index]]
        expected = sum(embedding.barycentric[index, k] * vertices[face[k]] for k in range(3))
        torch.testing.assert_close(points[index], expected)


def test_initial_scales_are_the_rms_distance_to_three_neighbours() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [100, 100, 100]])
    brute = torch.cdist(points, points).sort(dim=1).values[:, 1:4].square().mean(1).sqrt()
    torch.testing.assert_close(knn_scales(points), brute)


def test_coincident_and_single_points_have_a_positive_scale() -> None:
    assert bool((knn_scales(torch.zeros(5, 3)) > 0).all())
    assert bool((knn_scales(torch.zeros(1, 3)) > 0).all())


def test_the_scale_of_two_points_is_their_distance() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.03, 0.04]])
    torch.testing.assert_close(knn_scales(points), torch.tensor([0.05, 0.05]))
