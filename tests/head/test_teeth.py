"""Teeth for a head model that has none: what they are bound to."""

from __future__ import annotations

from dataclasses import fields, replace

import torch
from heads import grid_head
from torch import Tensor

from avatar.config import load_config
from avatar.gaussians.mesh_embedding import knn_scales
from avatar.gaussians.uv import bound_texels, painted, uv_texels
from avatar.head.assets import HeadAssets
from avatar.head.features import mouth_rim
from avatar.head.model import HeadModel
from avatar.head.teeth import GRID, ROWS, with_teeth
from avatar.runs.model_registry import make_avatar
from avatar.types import IDENTITY_6D, HeadParams

COUNT = GRID[0] * GRID[1]  # vertices of a row


def test_all_that_the_head_model_has_stays_as_it_is(assets: HeadAssets) -> None:
    grown, V, F = with_teeth(assets), assets.num_vertices, len(assets.faces)
    assert grown.num_vertices == V + len(ROWS) * COUNT
    for field in fields(HeadAssets):
        own, new = getattr(assets, field.name), getattr(grown, field.name)
        if isinstance(own, Tensor):
            assert torch.equal(new[tuple(slice(n) for n in own.shape)], own) and new.shape != own.shape, field.name
        else:
            assert new is own, field.name
    assert int(grown.faces[F:].min()) == V and int(grown.faces[F:].max()) == grown.num_vertices - 1
    params = HeadParams(torch.randn(assets.num_expressions), *(torch.randn(n) for n in (6, 12, 2, 6)))
    identity = torch.randn(20)
    posed, before = (HeadModel(head, identity).vertices(params) for head in (grown, assets))
    torch.testing.assert_close(posed[:V], before, rtol=0, atol=1e-6)


def test_the_rows_lie_behind_the_lips_as_wide_as_the_mouth(assets: HeadAssets) -> None:
    upper, lower = rows_of(assets, with_teeth(assets).template)
    lips, rim = assets.template[assets.regions["lips"]], assets.template[mouth_rim(assets)]
    for row in (upper, lower):
        torch.testing.assert_close(row[:, 0].aminmax(), rim[:, 0].aminmax(), rtol=0, atol=1e-3)
        assert 0.012 < float(lips[:, 2].max() - row[:, 2].max()) < 0.018
    meeting = float(rim[:, 1].mean())
    assert float(lower[:, 1].min()) < float(upper[:, 1].min()) < meeting < float(lower[:, 1].max()) < upper[:, 1].max()
    aside = torch.tensor([-0.5, 0.4, 0.1])
    moved = with_teeth(replace(assets, template=assets.template + aside)).template
    torch.testing.assert_close(moved, with_teeth(assets).template + aside, rtol=0, atol=1e-6)
    # Behind the skin at the corners of the mouth, too.
    corner = rim[rim[:, 0].argmax()]
    assert float(upper[upper[:, 0].argmax(), 2]) < float(corner[2]) - 0.005


def test_the_upper_row_keeps_with_the_skull_and_the_lower_with_the_chin(assets: HeadAssets) -> None:
    head = HeadModel(with_teeth(assets), torch.zeros(3))
    identity = torch.tensor(IDENTITY_6D)
    tilt = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.97, -0.243])
    expression = torch.randn(assets.num_expressions)
    rest = head.neutral_vertices()
    still = HeadParams(torch.zeros_like(expression), identity, identity.repeat(2), torch.zeros(2), identity)
    for params in (replace(still, jaw=tilt), replace(still, expression=expression)):
        moved = head.vertices(params) - rest
        upper, lower = rows_of(assets, moved)
        torch.testing.assert_close(upper, torch.zeros(COUNT, 3), rtol=0, atol=1e-6)
        chin = moved[chin_of(assets)].mean(dim=0)
        assert float(chin.norm()) > 3e-4
        assert float((lower.mean(dim=0) - chin).norm()) < 0.5 * float(chin.norm())
    beneath = rows_of(assets, head.vertices(replace(still, neck=tilt)))
    for there, row in zip(beneath, rows_of(assets, rest), strict=True):
        torch.testing.assert_close(there, row, rtol=0, atol=1e-5)  # the torso turns, the teeth do not


def test_teeth_are_found_without_named_regions(assets: HeadAssets) -> None:
    named, found = with_teeth(assets), with_teeth(replace(assets, regions={}))
    assert torch.equal(named.template, found.template) and torch.equal(named.weights, found.weights)


def test_a_head_without_an_opening_between_the_lips_has_none() -> None:
    assets = grid_head()
    assert len(mouth_rim(assets)) == 0 and with_teeth(assets) is assets
    config = load_config(["model.uv_size=24", "model.mlp_width=16", "model.mlp_layers=2", "model.teeth=true"]).model
    avatar = make_avatar(assets, torch.zeros(3), config)
    assert avatar.mesh is avatar.head and len(avatar) == len(
        make_avatar(assets, torch.zeros(3), replace(config, teeth=False))
    )


def test_texels_of_teeth_lie_below_the_map_about_as_fine_as_those_of_the_lips(assets: HeadAssets) -> None:
    grown = with_teeth(assets)
    own, all_of_it = uv_texels(assets, 128, 2), bound_texels(assets, grown, 128, 2)
    N = len(own.face)
    assert all(torch.equal(a, b[:N]) for a, b in zip(own, all_of_it, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(own, bound_texels(assets, assets, 128, 2), strict=True))
    face, row, side = all_of_it.face[N:], all_of_it.row[N:], all_of_it.side[N:]
    assert bool((row >= side).all()) and set(side.tolist()) == {256}
    assert 400 < len(face) < 900 and bool((face >= len(assets.faces)).all())
    points = (grown.template[grown.faces[all_of_it.face]] * all_of_it.barycentric[:, :, None]).sum(dim=1)
    spacing = knn_scales(points[N:], 1)
    assert 0.0012 < float(spacing.median()) < 0.0014
    is_lip = torch.isin(assets.faces[own.face], assets.regions["lips"]).all(dim=1)
    assert 0.5 < float(spacing.median() / knn_scales(points[:N][is_lip], 1).median()) < 2
    values = all_of_it.face[:, None].numpy()
    for ours, theirs in zip(painted(all_of_it, values), painted(own, values[:N]), strict=True):
        assert (ours == theirs).all()


def test_a_raster_too_coarse_for_teeth_has_none(assets: HeadAssets) -> None:
    plain = uv_texels(assets, 5)
    assert all(torch.equal(a, b) for a, b in zip(plain, bound_texels(assets, with_teeth(assets), 5, 1), strict=True))


def rows_of(assets: HeadAssets, vertices: Tensor) -> tuple[Tensor, ...]:
    return vertices[assets.num_vertices :].split(COUNT)


def chin_of(assets: HeadAssets) -> Tensor:
    points = assets.template
    lips = points[assets.regions["lips"]]
    place = torch.stack((lips[:, 0].mean(), lips[:, 1].min() - 0.02, lips[:, 2].max()))
    return torch.nonzero((points - place).norm(dim=1) < 0.012).flatten()
