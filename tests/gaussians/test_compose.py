from __future__ import annotations

import torch
from kornia.geometry.quaternion import Quaternion

from avatar.gaussians.compose import compose, quaternion_product, split_offsets


def test_the_quaternion_product_agrees_with_kornia() -> None:
    a, b = torch.randn(9, 4), torch.randn(9, 4)
    expected = (Quaternion(a) * Quaternion(b)).data
    torch.testing.assert_close(quaternion_product(a, b), expected)


def test_zero_offsets_scale_the_delta_quaternion_only() -> None:
    N = 6
    quats = torch.nn.functional.normalize(torch.randn(N, 4), dim=1)
    points, log_scales, logits = torch.randn(N, 3), torch.randn(N, 3), torch.randn(N)
    sh = torch.randn(N, 16, 3)
    g = compose(points, 3.0 * quats, log_scales, logits, sh, split_offsets(torch.zeros(N, 10)))
    torch.testing.assert_close(g.means, points)
    torch.testing.assert_close(g.quats, quats)
    torch.testing.assert_close(g.scales, log_scales.exp())
    torch.testing.assert_close(g.opacities, logits.sigmoid())
    assert g.sh is sh


def test_flashavatars_quirks() -> None:
    """Rotation delta (exp(r0), r1, r2, r3) on the right; exp(s) multiplies the logarithm of the scale."""
    raw = torch.randn(5, 10)
    d = torch.tanh(raw)
    points, log_scales = torch.randn(5, 3), -torch.rand(5, 3) - 3
    base = torch.nn.functional.normalize(torch.randn(5, 4), dim=1)
    g = compose(points, base, log_scales, torch.zeros(5), torch.zeros(5, 1, 3), split_offsets(raw))
    torch.testing.assert_close(g.means, points + d[:, :3])
    delta = torch.cat((d[:, 3:4].exp(), d[:, 4:7]), dim=1)
    expected = (Quaternion(base) * Quaternion(delta)).data
    torch.testing.assert_close(g.quats, expected / expected.norm(dim=1, keepdim=True))
    torch.testing.assert_close(g.scales, torch.exp(log_scales * d[:, 7:].exp()))
