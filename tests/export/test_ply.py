"""Exported Gaussians stand upright along the axis that is asked for."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_file import read_splats

from avatar.export.ply import Up, encode_ply
from avatar.splat.sh import sh_colours
from avatar.types import Gaussians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("up", "matrix"), [
    ("-y", [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]), ("y", [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    ("z", [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
])  # fmt: skip
def test_an_axis_up_turns_places_shapes_and_the_colours_of_every_direction(
    up: Up, matrix: list[list[float]], degree: int
) -> None:
    """By matrices that the code does not have; the axis `up` is where head space has y."""
    R = torch.tensor(matrix, dtype=torch.float32)
    assert (R @ torch.tensor([0.0, 1.0, 0.0])).tolist() == [0, (up == "y") - (up == "-y"), up == "z"]
    generator = torch.Generator().manual_seed(degree)
    N, K = 200, (degree + 1) ** 2
    before = Gaussians(
        torch.randn(N, 3, generator=generator),
        torch.nn.functional.normalize(torch.randn(N, 4, generator=generator), dim=1),
        torch.rand(N, 3, generator=generator) + 0.1,
        torch.rand(N, generator=generator),
        0.3 * torch.randn(N, K, 3, generator=generator),
    )
    after = read_splats(encode_ply(before, up=up))
    torch.testing.assert_close(after.means, before.means @ R.T)
    torch.testing.assert_close(covariances(after), R @ covariances(before) @ R.T, atol=1e-5, rtol=1e-5)
    directions = torch.nn.functional.normalize(torch.randn(N, 3, generator=generator), dim=1)
    colours = sh_colours(before.sh, directions, degree)
    torch.testing.assert_close(sh_colours(after.sh, directions @ R.T, 3), colours, atol=1e-5, rtol=0)
    if degree and up != "y":
        assert (sh_colours(after.sh, directions, 3) - colours).abs().max() > 0.1, "the directions matter"


def covariances(gaussians: Gaussians) -> torch.Tensor:
    rotations = torch.from_numpy(Rotation.from_quat(gaussians.quats.numpy(), scalar_first=True).as_matrix()).float()
    return rotations @ torch.diag_embed(gaussians.scales**2) @ rotations.mT
