"""HyperGaussians through their covariance against closed forms in float64, and against the inverse covariance trick."""

from __future__ import annotations

import pytest
import torch

from avatar.baselines.covariance import CovarianceHead, CovarianceHeads, conditional_mean
from avatar.gaussians.hyper import HyperHead, HyperHeads
from avatar.gaussians.hyper_cpu import HEADS


def random_head(num: int, m: int, n: int, spread: float = 0.4) -> CovarianceHead:
    head = CovarianceHead(num, m, n).double()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter += spread * torch.randn_like(parameter)
    return head


def full_factor(head: CovarianceHead) -> torch.Tensor:
    """L [N, m+n, m+n], entry by entry."""
    size, num = head.mean.shape
    L = torch.zeros(num, size, size, dtype=torch.float64)
    place = 0
    for i in range(size):
        for j in range(i + 1):
            value = head.factor.detach()[place]
            L[:, i, j] = torch.exp(value) if i == j else value
            place += 1
    assert place == len(head.factor)
    return L


def closed_form(L: torch.Tensor, mean: torch.Tensor, latents: torch.Tensor, m: int) -> torch.Tensor:
    """Bishop, eq. 2.81, by an explicit inverse; mean and latents [N, .]."""
    sigma = L @ L.mT
    gain = sigma[:, :m, m:] @ torch.linalg.inv(sigma[:, m:, m:])
    return mean[:, :m] + (gain @ (latents - mean[:, m:])[..., None]).squeeze(-1)


@pytest.mark.parametrize("m", [1, 3, 4])
@pytest.mark.parametrize("n", [1, 2, 8, 17])
def test_the_conditional_mean_is_that_of_the_joint_covariance(m: int, n: int) -> None:
    head, latents = random_head(20, m, n), torch.randn(n, 20, dtype=torch.float64)
    expected = closed_form(full_factor(head), head.mean.detach().T, latents.T, m)
    torch.testing.assert_close(head(latents).detach().T, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("m", "n"), [(1, 1), (3, 4), (4, 3)])
def test_gradients_of_the_conditional_mean(m: int, n: int) -> None:
    head = random_head(3, m, n)
    inputs = head.mean, head.factor, torch.randn(n, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(conditional_mean, inputs)


def test_the_same_distribution_through_its_precision_has_the_same_mean() -> None:
    """What the inverse covariance trick leaves unchanged, with its own parameters drawn from this covariance."""
    m, n, num = 3, 8, 20
    head, latents = random_head(num, m, n), torch.randn(n, num, dtype=torch.float64)
    L = full_factor(head)
    root = torch.linalg.cholesky(torch.linalg.inv(L @ L.mT))
    lower = torch.tril(root[:, :m, :m], -1) + torch.diag_embed(torch.log(root.diagonal(dim1=1, dim2=2)[:, :m]))
    by_precision = HyperHead(head.mean.detach().T, lower, root[:, m:, :m])
    torch.testing.assert_close(head(latents).detach().T, by_precision.conditional_mean(latents.T), rtol=1e-8, atol=1e-8)


def test_float32_is_near_float64_and_folded_heads_give_what_the_heads_give() -> None:
    heads = CovarianceHeads(40, 8)
    with torch.no_grad():
        for parameter in heads.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    latents = torch.randn(40, 8)
    found = heads(latents).detach()
    exact = CovarianceHeads(40, 8).double()
    exact.load_state_dict(heads.state_dict())
    torch.testing.assert_close(found, exact(latents.double()).float().detach(), rtol=1e-4, atol=1e-4)
    folded = heads.fold()
    assert folded.matrix.dtype is folded.bias.dtype is torch.float32
    torch.testing.assert_close(folded(latents), found, rtol=1e-4, atol=1e-4)


def test_the_start_is_that_of_the_trick() -> None:
    """Zero offsets, whatever the latent, and a gradient by every cross term."""
    heads, latents = CovarianceHeads(5, 8), torch.randn(5, 8)
    offsets = heads(latents)
    assert torch.equal(offsets, HyperHeads(5, 8)(latents))
    offsets.sum().backward()
    for name, m in HEADS.items():
        gradient = heads.get_parameter(f"{name}.factor").grad
        assert gradient is not None
        cross = [(m + i) * (m + i + 1) // 2 + j for i in range(8) for j in range(m)]
        assert bool((gradient[cross] != 0).all())
