"""Eyes and mouth of a head model that names no regions."""

from __future__ import annotations

from dataclasses import replace

import torch

from avatar.gaussians.uv import detailed_faces, uv_texels
from avatar.head.assets import HeadAssets
from avatar.head.features import eyeballs, openings


def test_what_turns_with_the_eyes_are_the_eyeballs(assets: HeadAssets) -> None:
    named = torch.cat((assets.regions["left_eyeball"], assets.regions["right_eyeball"]))
    assert torch.equal(eyeballs(assets), named.sort().values)


def test_openings_are_those_of_the_face(assets: HeadAssets) -> None:
    """The mouth's rim and the sockets', not the neck's; nor a hole in the scalp."""
    rims = openings(assets)
    points = assets.template
    assert not set(rims.tolist()) & set(assets.regions["boundary"].tolist())
    lips = points[assets.regions["lips"]]
    assert float(torch.cdist(lips, points[rims]).amin(dim=1).max()) < 0.02
    scalp = torch.isin(assets.faces, assets.regions["scalp"]).all(dim=1)
    top = assets.faces[scalp][points[assets.faces[scalp]][:, :, 1].mean(dim=1).argmax()]
    kept = ~(assets.faces == top).all(dim=1)
    assert int(kept.sum()) == len(assets.faces) - 1
    holed = replace(assets, faces=assets.faces[kept], uv_faces=assets.uv_faces[kept])
    assert torch.equal(openings(holed), rims)


def test_detail_lies_about_the_same_features_with_and_without_names(assets: HeadAssets) -> None:
    named, found = detailed_faces(assets), detailed_faces(replace(assets, regions={}))
    assert bool(found[named].all())
    assert int(found.sum()) < 1.2 * int(named.sum())


def test_a_head_without_either_has_no_detail(assets: HeadAssets) -> None:
    still = torch.zeros_like(assets.weights)
    still[:, 0] = 1.0
    far = replace(assets, regions={}, weights=still, joint_regressor=torch.zeros_like(assets.joint_regressor))
    far = replace(far, template=far.template + torch.tensor([0.0, 0.0, 1.0]))
    assert not bool(detailed_faces(far).any())
    assert all(torch.equal(a, b) for a, b in zip(uv_texels(far, 24, detail=2), uv_texels(far, 24), strict=True))
