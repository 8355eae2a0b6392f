"""N-dimensional Gaussians against the closed forms of a joint normal distribution in float64."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch.distributions import MultivariateNormal

from avatar.baselines.ndgs import NdGaussians, NdgsAvatar, Slice


def random_gaussians(num: int, n: int, spread: float = 0.4) -> NdGaussians:
    gaussians = NdGaussians(num, n).double()
    with torch.no_grad():
        for parameter in gaussians.parameters():
            parameter += spread * torch.randn_like(parameter)
    return gaussians


def joint(gaussians: NdGaussians, shape: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and covariance of (position, latent), where `shape` [N, 3, 3] is the conditional covariance."""
    n, num = gaussians.latent_size, gaussians.mean.shape[1]
    B = torch.zeros(num, n, n, dtype=torch.float64)
    rows, columns = torch.tril_indices(n, n)
    B[:, rows, columns] = gaussians.root.detach().T
    diagonal = torch.arange(n)
    B[:, diagonal, diagonal] = B[:, diagonal, diagonal].exp()
    A = gaussians.cross.detach().permute(2, 0, 1)
    sigma = torch.cat((torch.cat((A @ A.mT + shape, A @ B.mT), 2), torch.cat((B @ A.mT, B @ B.mT), 2)), 1)
    return gaussians.mean.detach().T, sigma


def random_shapes(num: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Quaternions, log-scales and R S^2 R^T of them."""
    quats = torch.nn.functional.normalize(torch.randn(num, 4, dtype=torch.float64), dim=-1)
    w, x, y, z = quats.unbind(-1)
    R = torch.stack(
        (
            torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
            torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
            torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
        ),
        dim=-2,
    )
    log_scales = 0.5 * torch.randn(num, 3, dtype=torch.float64)
    RS = R * log_scales.exp()[:, None]
    return quats, log_scales, RS @ RS.mT


@pytest.mark.parametrize("n", [1, 3, 8])
def test_a_slice_is_the_conditional_distribution_of_the_joint_one(n: int) -> None:
    num = 12
    gaussians, latents = random_gaussians(num, n), torch.randn(num, n, dtype=torch.float64)
    quats, log_scales, shape = random_shapes(num)
    mean, sigma = joint(gaussians, shape)
    gain = sigma[:, :3, 3:] @ torch.linalg.inv(sigma[:, 3:, 3:])
    conditional = sigma[:, :3, :3] - gain @ sigma[:, 3:, :3]
    torch.testing.assert_close(conditional, shape, rtol=1e-9, atol=1e-9)

    position, density = (field.detach() for field in gaussians(latents))
    expected = mean[:, :3] + (gain @ (latents - mean[:, 3:])[..., None]).squeeze(-1)
    torch.testing.assert_close(position, expected, rtol=1e-9, atol=1e-9)
    distribution = MultivariateNormal(mean, covariance_matrix=sigma)
    largest, here = distribution.log_prob(mean), distribution.log_prob(torch.cat((expected, latents), dim=-1))
    torch.testing.assert_close(density, torch.exp(here - largest), rtol=1e-9, atol=1e-12)
    assert float(density.min()) < 0.9 and float(density.max()) <= 1.0

    points, logits = torch.randn(num, 3, dtype=torch.float64), torch.randn(num, dtype=torch.float64)
    avatar = SimpleNamespace(base=lambda: (quats, log_scales, logits, torch.zeros(num, 1, 3)))
    splats = NdgsAvatar.apply_offsets(avatar, points, Slice(1e-3 * position, density))
    torch.testing.assert_close(splats.means, points + torch.tanh(1e-3 * expected))
    torch.testing.assert_close(splats.opacities, torch.sigmoid(logits) * density)
    assert torch.equal(splats.scales, log_scales.exp())
    torch.testing.assert_close(splats.quats, quats)


def test_gradients_of_a_slice() -> None:
    gaussians = random_gaussians(3, 4)
    names = [name for name, _ in gaussians.named_parameters()]

    def sliced(latents: torch.Tensor, *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(torch.func.functional_call(gaussians, dict(zip(names, values, strict=True)), (latents,)))

    latents = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sliced, (latents, *gaussians.parameters()))


def test_at_the_start_nothing_moves_but_what_could_move_it_has_a_gradient() -> None:
    gaussians, latents = NdGaussians(5, 8), torch.randn(5, 8)
    position, density = gaussians(latents)
    assert torch.equal(position, torch.zeros(5, 3))
    torch.testing.assert_close(density, torch.exp(-0.5 * latents.square().sum(-1)))
    position.sum().backward()
    assert gaussians.cross.grad is not None and bool((gaussians.cross.grad != 0).all())
