"""A texture has the avatar's own colours, as they are seen."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lively import lively_avatar

from avatar.export.bake_texture import _normals, _seen, bake_texture
from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.uv import uv_texels
from avatar.motion.orbit import orbited
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.splat.sh import C0

SIZE = 48
COLOUR = torch.tensor([0.7, 0.4, 0.2])


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    """A still avatar of one colour that is not quite opaque."""
    one = lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run")
    model = copy.deepcopy(one.avatar)
    assert model.deformation is not None and model.hyper is not None
    with torch.no_grad():
        for parameter in (model.sh_rest, *model.deformation.parameters(), *model.hyper.parameters()):
            parameter.zero_()
        model.sh_dc[:, 0] = (COLOUR - 0.5) / C0
        model.log_scales.fill_(float(torch.log(torch.tensor(0.004))))
        model.opacity_logits.fill_(-1.0)
    return replace(one, avatar=model)


def over(trained: TrainedAvatar, colour: tuple[float, float, float]) -> TrainedAvatar:
    data = replace(trained.config.data, background=colour)
    return replace(trained, config=replace(trained.config, data=data))


def baked(trained: TrainedAvatar) -> np.ndarray:
    return bake_texture(trained, trained.rest_params(), SIZE).astype(int)


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.0, 1.0, 0.0)])
def test_the_background_is_not_baked_in(trained: TrainedAvatar, background: tuple[float, float, float]) -> None:
    """Nor is a texture darker where some of it shines through."""
    one = over(trained, background)
    alpha = one.render(one.rest_params(), one.rest_camera(96)).alpha
    assert ((alpha > 0.75) & (alpha < 0.98)).sum() > 100
    assert np.abs(baked(one) - 255 * COLOUR.numpy()).max() <= 2


def test_a_texture_has_the_colours_of_the_side_from_which_it_is_seen(trained: TrainedAvatar) -> None:
    """What is in front is redder from the front than from behind."""
    model = copy.deepcopy(trained.avatar)
    with torch.no_grad():
        model.opacity_logits.fill_(4.0)
        model.sh_rest[:, 1, 0] = -0.6  # by z of the direction from the camera to it
    one = replace(trained, avatar=model)
    picture = one.render(one.rest_params(), one.rest_camera(96))
    seen = 255 * picture.image[picture.alpha > 0.99].median(dim=0).values
    texels = uv_texels(one.assets, SIZE)
    normals = Embedding(one.assets, texels).points(one.avatar.head.neutral_vertices())
    in_front = (normals[:, 2] > normals[:, 2].quantile(0.7)).numpy()
    found = np.median(baked(one)[texels.row.numpy()[in_front], texels.column.numpy()[in_front]], axis=0)
    assert abs(float(seen[0]) - 255 * 0.7) > 40
    assert np.abs(found - seen.numpy()).max() < 12


def test_what_nobody_sees_has_the_gaussians_own_colour(trained: TrainedAvatar, monkeypatch: pytest.MonkeyPatch) -> None:
    texels, vertices = uv_texels(trained.assets, SIZE), trained.avatar.vertices(trained.rest_params())
    points = Embedding(trained.assets, texels).points(vertices)
    normals = _normals(vertices, trained.assets.faces)[texels.face]
    near = orbited(trained.rest_camera(96), zoom=4)
    x, y = near.project(points).T[:2]
    is_outside = (x < 0) | (x > 96) | (y < 0) | (y > 96)
    seen = _seen(trained, vertices, points, normals, near)
    assert (x < 0).any() and (x > 97).any() and (y < 0).any() and (y > 97).any()
    assert (seen[~is_outside] > 0).any() and not seen[is_outside].any()
    for name in ("YAWS", "PITCHES"):
        monkeypatch.setattr(f"avatar.export.bake_texture.{name}", (0.0,))
    monkeypatch.setattr("avatar.export.bake_texture._seen", lambda *_: torch.zeros(1))
    assert np.abs(baked(trained) - 255 * COLOUR.numpy()).max() <= 2
