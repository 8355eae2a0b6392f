from __future__ import annotations

import math

import pytest
import torch

from avatar.gaussians.hyper import Factor, HyperHead, HyperHeads, conditional_mean


def random_head(num: int, m: int, n: int, spread: float = 0.4) -> HyperHead:
    head = HyperHead(num, m, n).double()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.copy_(spread * torch.randn_like(parameter))
    return head


def full_covariance(head: HyperHead) -> torch.Tensor:
    """The joint covariance of (attribute, latent), with a random L22, which the conditional must not depend on."""
    m, n = head.attribute_size, head.latent_size
    factor = head.factor()
    num = len(head.mean)
    L = torch.zeros(num, m + n, m + n, dtype=torch.float64)
    L[:, :m, :m], L[:, m:, :m] = factor.L11, factor.L21
    # Small off the diagonal: a random triangular matrix is else so badly conditioned that the DIRECT form fails.
    L22 = torch.tril(0.2 / n**0.5 * torch.randn(num, n, n, dtype=torch.float64), -1)
    L[:, m:, m:] = L22 + torch.diag_embed(0.5 + torch.rand(num, n, dtype=torch.float64))
    return torch.linalg.inv(L @ L.transpose(1, 2))


@pytest.mark.parametrize("m", [3, 4])
@pytest.mark.parametrize("n", [1, 2, 8, 32])
def test_the_inverse_covariance_trick_equals_the_direct_form(m: int, n: int) -> None:
    """Paper, eq. 3: mean and covariance of a normal distribution conditioned through its covariance matrix."""
    head = random_head(50, m, n)
    latents = torch.randn(50, n, dtype=torch.float64)
    covariance = full_covariance(head)
    aa, ab, bb = covariance[:, :m, :m], covariance[:, :m, m:], covariance[:, m:, m:]
    mean_a, mean_b = head.mean[:, :m], head.mean[:, m:]
    gain = ab @ torch.linalg.inv(bb)
    direct_mean = mean_a + (gain @ (latents - mean_b)[:, :, None]).squeeze(-1)
    direct_covariance = aa - gain @ ab.transpose(1, 2)

    torch.testing.assert_close(head(latents), direct_mean, rtol=1e-8, atol=1e-8)
    L11 = head.factor().L11
    torch.testing.assert_close(torch.linalg.inv(L11 @ L11.transpose(1, 2)), direct_covariance, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(head.log_det_covariance(), torch.logdet(direct_covariance), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("m", [1, 3, 4])
def test_gradients_of_the_conditional_mean(m: int) -> None:
    head = random_head(4, m, 3)
    mean_a, mean_b = (t.detach().clone().requires_grad_() for t in head.mean.split((m, 3), dim=1))
    lower, cross = (t.detach().clone().requires_grad_() for t in (head.lower, head.cross))
    latents = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)

    def mean_of(lower, cross, mean_a, mean_b, latents):
        L11 = torch.tril(lower, -1) + torch.diag_embed(torch.exp(torch.diagonal(lower, dim1=-2, dim2=-1)))
        return conditional_mean(mean_a, mean_b, Factor(L11, cross), latents)

    assert torch.autograd.gradcheck(mean_of, (lower, cross, mean_a, mean_b, latents))


def test_at_the_start_the_offsets_are_zero_but_their_gradient_is_not() -> None:
    heads = HyperHeads(5, 8)
    latents = torch.randn(5, 8)
    offsets = heads(latents)
    assert torch.equal(offsets, torch.zeros(5, 10))
    offsets.sum().backward()
    assert heads.position.cross.grad is not None and bool((heads.position.cross.grad != 0).all())


def test_uncertainty_is_the_papers_sum_over_heads() -> None:
    heads = HyperHeads(6, 2)
    with torch.no_grad():
        heads.position.lower[:, 0, 0] = math.log(2.0)
        heads.scale.lower[:, 2, 2] = math.log(3.0)
        heads.scale.lower[:, 2, 0] = 17.0  # off the diagonal: does not count
    torch.testing.assert_close(heads.uncertainty(), torch.full((6,), -2.0 * math.log(6.0)))


@pytest.mark.parametrize("n", [1, 2, 4, 8, 16, 32, 64])
def test_parameters_are_counted_as_in_the_paper(n: int) -> None:
    """Supplement, table 3, with its 14,876 Gaussians: 375K of the network and these heads."""
    from avatar.gaussians.deformation import DeformationMLP

    published = {1: "1.2M", 2: "1.4M", 4: "1.8M", 8: "2.6M", 16: "4.1M", 32: "7.2M", 64: "13.4M"}
    with torch.device("meta"):
        modules = HyperHeads(14_876, n), DeformationMLP(51, 120, n)
    count = sum(p.numel() for module in modules for p in module.parameters())
    assert f"{count / 1e6:.1f}M" == published[n]


def test_a_latent_needs_a_dimension() -> None:
    with pytest.raises(ValueError, match="at least one latent dimension, got 0"):
        HyperHead(3, 3, 0)
