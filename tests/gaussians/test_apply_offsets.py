from __future__ import annotations

import pytest
import torch
from kornia.geometry.quaternion import Quaternion

from avatar.gaussians.apply_offsets import apply_offsets, quaternion_product


def test_the_quaternion_product_agrees_with_kornia() -> None:
    a, b = torch.randn(9, 4), torch.randn(9, 4)
    expected = (Quaternion(a) * Quaternion(b)).data
    torch.testing.assert_close(quaternion_product(a, b), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["kernel", "plain"])
def test_zero_offsets_scale_the_delta_quaternion_only(dtype: torch.dtype) -> None:
    N = 6
    quats = torch.nn.functional.normalize(torch.randn(N, 4, dtype=dtype), dim=1)
    points, log_scales, logits, sh = (torch.randn(*shape, dtype=dtype) for shape in ((N, 3), (N, 3), (N,), (N, 16, 3)))
    g = apply_offsets(points, 3.0 * quats, log_scales, logits, sh, torch.zeros(N, 10, dtype=dtype))
    torch.testing.assert_close(g.means, points)
    torch.testing.assert_close(g.quats, quats)
    torch.testing.assert_close(g.scales, log_scales.exp())
    torch.testing.assert_close(g.opacities, logits.sigmoid())
    assert g.sh is sh


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["kernel", "plain"])
def test_flashavatars_quirks(dtype: torch.dtype) -> None:
    """Rotation delta (exp(r0), r1, r2, r3) on the right; exp(s) multiplies the logarithm of the scale."""
    raw = torch.randn(5, 10, dtype=dtype)
    d = torch.tanh(raw)
    points, log_scales = torch.randn(5, 3, dtype=dtype), -torch.rand(5, 3, dtype=dtype) - 3
    base = torch.nn.functional.normalize(torch.randn(5, 4, dtype=dtype), dim=1)
    logits, sh = torch.zeros(5, dtype=dtype), torch.zeros(5, 1, 3, dtype=dtype)
    g = apply_offsets(points, base, log_scales, logits, sh, raw)
    torch.testing.assert_close(g.means, points + d[:, :3])
    delta = torch.cat((d[:, 3:4].exp(), d[:, 4:7]), dim=1)
    expected = (Quaternion(base) * Quaternion(delta)).data
    torch.testing.assert_close(g.quats, expected / expected.norm(dim=1, keepdim=True))
    torch.testing.assert_close(g.scales, torch.exp(log_scales * d[:, 7:].exp()))
