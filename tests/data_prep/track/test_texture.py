"""Skin points' own values and the light of each frame, separated."""

from __future__ import annotations

import torch
from test_surface import grid_head

from data_prep.track.fit.photometric_term import DEVIATION
from data_prep.track.fit.texture import light_basis, lit_texture

T, N = 6, 300


def scene(slopes: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Basis, texture, light and what they show: normals of a ball, lit from elsewhere in each frame."""
    generator = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(N, 3, generator=generator, dtype=torch.float64), dim=1)
    basis = torch.cat((torch.ones(N, 1, dtype=torch.float64), normals - normals.mean(0)), dim=1)
    texture = 0.2 + 0.5 * torch.rand(N, generator=generator, dtype=torch.float64)
    light = slopes * torch.randn(T, 4, generator=generator, dtype=torch.float64)
    light[:, 0] = torch.tensor([0.8, 0.9, 1.0, 1.0, 1.1, 1.2])
    light[:, 1:] -= light[:, 1:].mean(0)
    return basis, texture, light, (light @ basis.T) * texture


def test_a_texture_and_its_light_explain_what_they_made() -> None:
    basis, texture, light, values = scene(slopes=0.15)
    found = lit_texture(values, torch.ones(T, N, dtype=torch.float64), basis)
    error = (found.values(basis) - values).pow(2).mean().sqrt()
    assert float(error) < 2e-4 < 0.1 * DEVIATION
    torch.testing.assert_close(found.light, light, atol=5e-3, rtol=0)
    torch.testing.assert_close(found.texture, texture, atol=5e-3, rtol=0)
    even = lit_texture(values, torch.ones(T, N, dtype=torch.float64), basis[:, :1])
    assert even.light.shape == (T, 1)
    assert float((even.values(basis[:, :1]) - values).pow(2).mean().sqrt()) > 0.5 * DEVIATION  # a gain alone does not


def test_points_that_are_not_seen_and_outliers_say_nothing() -> None:
    basis, texture, light, values = scene(slopes=0.0)
    weights = torch.ones(T, N, dtype=torch.float64)
    weights[0, 5], values[0, 5] = 0.0, 9.0
    weights[:, 7] = 0.0
    values[2, 11] += 0.5
    found = lit_texture(values, weights, basis)
    seen = (torch.arange(N) != 7) & (torch.arange(N) != 11)
    torch.testing.assert_close(found.texture[seen], texture[seen], atol=2e-3, rtol=0)
    torch.testing.assert_close(found.light, light, atol=3e-3, rtol=0)
    assert found.texture[7] == 0.0 and abs(float(found.texture[11] - texture[11])) < 0.02


def test_few_points_do_not_make_up_a_light() -> None:
    basis, _, _, values = scene(slopes=0.0)
    noisy = values + DEVIATION * torch.randn(T, N, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights = torch.zeros(T, N, dtype=torch.float64)
    weights[1:] = 1.0
    weights[0, :2] = 1.0
    weights[3] = 0.0  # a frame in which nobody is seen
    found = lit_texture(noisy, weights, basis)
    assert bool(torch.isfinite(found.light).all()) and float(found.light[:, 1:].abs().max()) < 0.3


def test_the_basis_holds_the_unit_normals_of_the_resting_head() -> None:
    head = grid_head()
    corners, weights = head.faces[:9], torch.full((9, 3), 1 / 3, dtype=torch.float64)
    basis = light_basis(head, corners, weights)
    assert basis.shape == (9, 4) and torch.equal(basis[:, 0], torch.ones(9, dtype=torch.float64))
    a, b, c = head.template.double()[corners].unbind(1)
    flat = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    torch.testing.assert_close(basis[:, 1:].mean(0), torch.zeros(3, dtype=torch.float64))
    own = basis[:, 1:] - basis[:1, 1:]  # without the mean, differences of unit vectors
    assert float((own - (flat - flat[:1])).norm(dim=1).mean()) < 0.5
