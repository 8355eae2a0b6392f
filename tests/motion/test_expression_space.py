from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from heads import EXPRESSIONS, rest_params

from avatar.motion.expression_space import coordinates, fit_expressions
from avatar.types import HeadParams


def faces(expressions: torch.Tensor) -> list[HeadParams]:
    return [replace(rest_params(), expression=e) for e in expressions]


def training(frames: int = 500) -> torch.Tensor:
    """Two directions of different spread; the other three coefficients never move."""
    spread = torch.tensor([1.0, 0.3, 0, 0, 0])
    return torch.tensor([0.5, 0, 0, 0.2, 0]) + spread * torch.randn(frames, EXPRESSIONS)


def test_distances_are_mahalanobis_and_one_percent_of_the_training_is_far() -> None:
    points = training()
    space = fit_expressions(faces(points))
    distances = space.distances(faces(points))
    assert int((distances > 1.0).sum()) == 5
    moving = points[:, :2].double().numpy()
    inverse = np.linalg.inv(np.cov(moving.T, bias=True))
    centred = moving - moving.mean(axis=0)
    expected = np.sqrt(np.einsum("ti,ij,tj->t", centred, inverse, centred))
    np.testing.assert_allclose(distances.numpy() * space.far, expected, rtol=1e-5)


def test_a_direction_that_training_never_took_is_far() -> None:
    space = fit_expressions(faces(training()))
    usual, unseen = torch.tensor([1.5, 0, 0, 0.2, 0]), torch.tensor([0.5, 0, 0, 1.2, 0])
    near, far = space.distances(faces(torch.stack((usual, unseen)))).tolist()
    assert near < 0.5 and far > 5.0


@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
def test_still_directions_are_measured_by_the_liveliest(unit: float) -> None:
    """Whatever a head model's coefficients are counted in."""
    deviations = fit_expressions(faces(unit * training())).deviations
    assert float(deviations[0]) == pytest.approx(unit, rel=0.1)
    assert float(deviations[-1]) == pytest.approx(0.05 * float(deviations[0]))


def test_the_nearest_expression_is_clamped_to_the_range_and_projected() -> None:
    points = training()
    space = fit_expressions(faces(points))
    inside = faces(points[:50])
    for before, after in zip(inside, space.nearest(inside), strict=True):
        torch.testing.assert_close(after.expression, before.expression, rtol=0, atol=1e-5)
        torch.testing.assert_close(after.jaw, before.jaw, rtol=0, atol=1e-6)
    (clamped,) = space.nearest(faces(torch.tensor([[9.0, 0, 3.0, 0.2, 0]])))
    assert float(clamped.expression[0]) == pytest.approx(float(points[:, 0].max()), abs=0.1)
    assert clamped.expression[2:].tolist() == pytest.approx([0, 0.2, 0], abs=1e-5)


def test_the_jaw_is_a_coordinate() -> None:
    c, s = float(np.cos(0.3)), float(np.sin(0.3))
    open_jaw = replace(rest_params(), jaw=torch.tensor([1.0, 0, 0, 0, c, -s]))
    torch.testing.assert_close(coordinates([open_jaw])[0, -3:], torch.tensor([3.0, 0, 0]).double(), rtol=0, atol=1e-5)


def test_frames_that_never_move_have_a_space_too() -> None:
    space = fit_expressions(faces(torch.zeros(3, EXPRESSIONS)))
    assert space.distances(faces(torch.zeros(1, EXPRESSIONS))).tolist() == [0.0]
    assert 1.0 < float(space.distances(faces(torch.ones(1, EXPRESSIONS)))[0]) < 100.0
    assert space.nearest(faces(torch.ones(1, EXPRESSIONS)))[0].expression.tolist() == [0.0] * EXPRESSIONS


@pytest.mark.parametrize("seed", range(5))
def test_few_frames_have_a_space_without_a_nan(seed: int) -> None:
    points = torch.randn(3, EXPRESSIONS, generator=torch.Generator().manual_seed(seed))
    space = fit_expressions(faces(points))
    assert torch.isfinite(space.deviations).all() and float(space.distances(faces(points)).max()) <= 1.001
