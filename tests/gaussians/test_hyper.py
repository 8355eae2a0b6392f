from __future__ import annotations

import math

import pytest
import torch

from avatar.gaussians.hyper import Factor, HyperHead, HyperHeads, conditional_mean, pack, unpack
from avatar.gaussians.hyper_cpu import HEADS, packed_shape


def random_head(num: int, m: int, n: int, spread: float = 0.4) -> HyperHead:
    shapes = (num, m + n), (num, m, m), (num, n, m)
    return HyperHead(*(spread * torch.randn(shape, dtype=torch.float64) for shape in shapes))


def full_covariance(head: HyperHead) -> torch.Tensor:
    """The joint covariance of (attribute, latent), with a random L22, which the conditional must not depend on."""
    factor = head.factor()
    num, n, m = head.cross.shape
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

    torch.testing.assert_close(head.conditional_mean(latents), direct_mean, rtol=1e-8, atol=1e-8)
    L11 = head.factor().L11
    torch.testing.assert_close(torch.linalg.inv(L11 @ L11.transpose(1, 2)), direct_covariance, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(head.log_det_covariance(), torch.logdet(direct_covariance), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("m", [1, 3, 4])
def test_gradients_of_the_conditional_mean(m: int) -> None:
    head = random_head(4, m, 3)
    mean_a, mean_b, lower, cross = (t.clone().requires_grad_() for t in (*head.means(), head.lower, head.cross))
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
    assert heads.packed.grad is not None
    for head in unpack(heads.packed.grad, 5).values():
        assert bool((head.cross != 0).all())


def test_uncertainty_is_the_papers_sum_over_heads() -> None:
    heads = HyperHeads(6, 2)
    values = {name: head.lower.detach() for name, head in heads.heads().items()}
    values["position"][:, 0, 0] = math.log(2.0)
    values["scale"][:, 2, 2] = math.log(3.0)
    values["scale"][:, 2, 0] = 17.0  # off the diagonal: does not count
    heads.set_heads({name: head._replace(lower=values[name]) for name, head in heads.heads().items()})
    torch.testing.assert_close(heads.uncertainty(), torch.full((6,), -2.0 * math.log(6.0)))


@pytest.mark.parametrize("n", [1, 2, 4, 8, 16, 32, 64])
def test_parameters_are_counted_as_in_the_paper(n: int) -> None:
    """Supplement, table 3, with its 14,876 Gaussians: 375K of the network and these heads, factors as whole matrices."""
    from avatar.gaussians.deformation import DeformationMLP

    published = {1: "1.2M", 2: "1.4M", 4: "1.8M", 8: "2.6M", 16: "4.1M", 32: "7.2M", 64: "13.4M"}
    with torch.device("meta"):
        heads, network = HyperHeads(14_876, n), DeformationMLP(51, 120, n)
    count = sum(p.numel() for p in (*heads.state_dict().values(), *network.parameters()))
    assert f"{count / 1e6:.1f}M" == published[n]
    # In memory there is less: no upper triangles, but four Gaussians more than there are fill the last block.
    triangles = sum(m * (m - 1) // 2 for m in HEADS.values())
    whole = sum(value.numel() for value in heads.state_dict().values()) // 14_876
    assert heads.packed.numel() == 14_880 * (whole - triangles)


@pytest.mark.parametrize(("num", "n"), [(0, 1), (1, 8), (16, 3), (33, 17)])
def test_packing_loses_nothing_but_the_upper_triangles(num: int, n: int) -> None:
    heads = {name: random_head(num, m, n) for name, m in HEADS.items()}
    packed = pack(heads)
    assert packed.shape == packed_shape(num, n)
    for name, head in unpack(packed, num).items():
        given = heads[name]
        assert torch.equal(head.mean, given.mean) and torch.equal(head.cross, given.cross)
        assert torch.equal(head.lower, given.lower.tril())
    assert torch.equal(pack(unpack(packed, num)), packed)
    assert int((packed == 0).sum()) == (-num % 16) * packed.shape[1]


def test_a_state_dict_does_not_show_the_order_in_memory() -> None:
    heads, other = HyperHeads(6, 5), HyperHeads(6, 5)
    heads.set_heads({name: random_head(6, m, 5) for name, m in HEADS.items()})
    state = heads.state_dict()
    assert {name: tuple(value.shape) for name, value in state.items()} == {
        f"{head}.{name}": shape
        for head, m in HEADS.items()
        for name, shape in (("mean", (6, m + 5)), ("lower", (6, m, m)), ("cross", (6, 5, m)))
    }
    other.load_state_dict(state)
    assert torch.equal(other.packed, heads.packed)
    outer = torch.nn.ModuleDict({"inner": HyperHeads(6, 5)})
    outer.load_state_dict({f"inner.{name}": value for name, value in state.items()})
    assert torch.equal(outer["inner"].packed, heads.packed)


def test_a_state_dict_that_does_not_fit_is_refused() -> None:
    heads = HyperHeads(6, 5)
    state = {name: value + 1 for name, value in heads.state_dict().items()}
    without = {name: value for name, value in state.items() if name != "scale.cross"}
    for wrong, message in [
        (without, r"Missing key\(s\) in state_dict: \"scale.cross\""),
        ({**state, "scale.mean": state["scale.mean"][:5]}, r"scale.mean has shape \[5, 8\], not \[6, 8\]"),
    ]:
        with pytest.raises(RuntimeError, match=message):
            heads.load_state_dict(wrong)
        assert not bool(heads.packed.any())
    with pytest.raises(RuntimeError, match=r"Unexpected key\(s\) in state_dict: \"scale.crass\""):
        heads.load_state_dict({**state, "scale.crass": state["scale.cross"]})
    with pytest.raises(ValueError, match="the heads must be of 6 Gaussians and 5 latent dimensions"):
        heads.set_heads(HyperHeads(7, 5).heads())
