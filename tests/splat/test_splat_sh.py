"""Spherical harmonics against scipy's, and as an orthonormal family."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from avatar.splat.sh import sh_basis, sh_colours, sh_degree_of


def _directions(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)


def test_basis_is_the_real_part_family_of_scipy() -> None:
    d = _directions(200)
    x, y, z = d.numpy().T
    basis = sh_basis(d, 3).numpy()
    column = 0
    for degree in range(4):
        for order in range(-degree, degree + 1):
            complex_value = sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
            part = complex_value.real if order >= 0 else complex_value.imag
            expected = part * (np.sqrt(2) if order else 1)  # scipy's phase (-1)^m is the one of 3DGS files
            np.testing.assert_allclose(basis[:, column], expected, atol=1e-12, err_msg=f"{degree=} {order=}")
            column += 1


def test_lower_degrees_are_the_first_columns() -> None:
    d = _directions(10)
    for degree in range(3):
        assert torch.equal(sh_basis(d, degree), sh_basis(d, 3)[:, : (degree + 1) ** 2])


def test_colours_are_clamped_at_zero_without_gradient() -> None:
    sh = torch.zeros(1, 1, 3, dtype=torch.float64)
    sh[0, 0] = torch.tensor([-10.0, 0.0, 10.0])
    sh.requires_grad_()
    colours = sh_colours(sh, _directions(1), 0)
    assert colours[0, 0] == 0.0 and colours[0, 1] == 0.5
    (grad,) = torch.autograd.grad(colours.sum(), sh)
    assert grad[0, 0, 0] == 0.0 and grad[0, 0, 1] > 0 and grad[0, 0, 2] > 0


@pytest.mark.parametrize(("coefficients", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3)])
def test_degree_of_a_number_of_coefficients(coefficients: int, degree: int) -> None:
    assert sh_degree_of(coefficients) == degree


@pytest.mark.parametrize("coefficients", [0, 2, 3, 15, 25])
def test_other_numbers_of_coefficients_are_refused(coefficients: int) -> None:
    with pytest.raises(ValueError, match=f"1, 4, 9 or 16 coefficients.*got {coefficients}"):
        sh_degree_of(coefficients)
