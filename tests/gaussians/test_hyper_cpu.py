"""The compiled operator against the definition in avatar.gaussians.hyper, in float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avatar import _core
from avatar.bench.machine import available_simd
from avatar.gaussians.hyper import HyperHeads, unpack
from avatar.gaussians.hyper_cpu import condition

TOLERANCE = {"rtol": 2e-5, "atol": 2e-5}  # sums of up to 128 products in float32


def random_heads(num: int, n: int, seed: int = 0) -> HyperHeads:
    generator = torch.Generator().manual_seed(seed)
    heads = HyperHeads(num, n)
    values = {name: 0.4 * torch.randn(value.shape, generator=generator) for name, value in heads.state_dict().items()}
    heads.load_state_dict(values)
    return heads


def in_float64(heads: HyperHeads) -> HyperHeads:
    exact = HyperHeads(heads.num_gaussians, heads.latent_size).double()
    exact.load_state_dict(heads.state_dict())
    return exact


def gradients(heads: HyperHeads, latents: Tensor, cotangent: Tensor) -> dict[str, Tensor]:
    """The offsets and all gradients, by name."""
    leaf = latents.detach().requires_grad_()
    offsets = heads(leaf)
    of_latents, packed = torch.autograd.grad(offsets, (leaf, heads.packed), cotangent)
    return {"offsets": offsets.detach(), "latents": of_latents, **by_part(packed, heads.num_gaussians)}


def by_part(packed: Tensor, num: int) -> dict[str, Tensor]:
    heads = unpack(packed.detach(), num)
    return {f"{name}.{part}": value for name, head in heads.items() for part, value in head._asdict().items()}


@pytest.mark.parametrize("n", [1, 2, 3, 8, 9, 16, 33, 128])
@pytest.mark.parametrize("num", [0, 1, 7, 1000])
def test_values_and_gradients_are_those_of_the_definition(num: int, n: int) -> None:
    heads, latents, cotangent = random_heads(num, n), torch.randn(num, n), torch.randn(num, 10)
    found = gradients(heads, latents, cotangent)
    expected = gradients(in_float64(heads), latents.double(), cotangent.double())
    for name, value in expected.items():
        assert found[name].dtype == torch.float32
        torch.testing.assert_close(found[name].double(), value, **TOLERANCE, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.parametrize("n", [1, 8, 33])
def test_the_same_bits_for_any_number_of_threads_and_any_instructions(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    heads, latents, cotangent = random_heads(3001, n), torch.randn(3001, n), torch.randn(3001, 10)
    results = []
    for threads, simd in [("1", "baseline"), *((threads, simd) for threads in "125" for simd in available_simd())]:
        monkeypatch.setenv("AVATAR_THREADS", threads)
        monkeypatch.setenv("AVATAR_SIMD", simd)
        results.append(gradients(heads, latents, cotangent))
    for other in results[1:]:
        assert all(torch.equal(value, other[name]) for name, value in results[0].items())


def test_only_the_gradients_that_are_asked_for() -> None:
    heads, latents, cotangent = random_heads(40, 5), torch.randn(40, 5), torch.randn(40, 10)
    everything = gradients(heads, latents, cotangent)
    leaf = latents.clone().requires_grad_()
    heads.requires_grad_(False)
    assert torch.equal(torch.autograd.grad(heads(leaf), leaf, cotangent)[0], everything["latents"])
    heads.requires_grad_(True)
    heads(latents).backward(cotangent)
    assert heads.packed.grad is not None and latents.grad is None
    assert all(torch.equal(value, everything[name]) for name, value in by_part(heads.packed.grad, 40).items())
    heads.requires_grad_(False)
    assert not heads(latents).requires_grad
    with torch.no_grad():
        assert torch.equal(heads(leaf), everything["offsets"])


def test_strided_tensors() -> None:
    heads, latents, cotangent = random_heads(30, 6), torch.randn(6, 30), torch.randn(10, 30)
    found = gradients(heads, latents.T, cotangent.T)
    expected = gradients(heads, latents.T.contiguous(), cotangent.T.contiguous())
    assert all(torch.equal(found[name], value) for name, value in expected.items())
    strided = heads.packed.detach().transpose(0, 1).contiguous().transpose(0, 1)
    assert not strided.is_contiguous()
    assert torch.equal(condition(latents.T, strided), found["offsets"])


def test_parameters_at_any_address() -> None:
    heads, latents, cotangent = random_heads(50, 3), torch.randn(50, 3), torch.randn(50, 10)
    expected = gradients(heads, latents, cotangent)
    memory = torch.zeros(heads.packed.numel() + 1)
    heads.packed = torch.nn.Parameter(memory[1:].view_as(heads.packed).copy_(heads.packed.detach()))
    assert heads.packed.data_ptr() % 64 == 4
    found = gradients(heads, latents, cotangent)
    assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_the_last_block_is_filled_with_zeros_that_stay() -> None:
    heads = random_heads(21, 4)
    optimizer = torch.optim.Adam(heads.parameters(), lr=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        heads(torch.randn(21, 4)).square().sum().backward()
        optimizer.step()
    assert bool((heads.packed[-1, :, :5] != 0).all()) and not bool(heads.packed[-1, :, 5:].any())


def test_a_gradient_in_use_is_not_written_over() -> None:
    heads, latents, cotangent = random_heads(300, 4), torch.randn(300, 4), torch.randn(300, 10)
    before = _core.large_tensor([3, 5]).data_ptr()
    assert _core.large_tensor([3, 5]).data_ptr() == before  # what is dropped is used again
    heads(latents).backward(cotangent)
    kept = heads.packed.grad
    assert kept is not None
    copy, view, heads.packed.grad = kept.clone(), kept[3:], None
    del kept
    others = [gradients(heads, latents, torch.randn(300, 10)) for _ in range(3)]
    assert torch.equal(view, copy[3:])
    assert not torch.equal(others[0]["scale.cross"], others[1]["scale.cross"])


@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
@pytest.mark.parametrize("index", range(10))
def test_what_is_not_finite_shows_and_stays_with_its_gaussian(index: int, poison: float) -> None:
    heads, latents, cotangent = random_heads(40, 9), torch.randn(40, 9), torch.randn(40, 10)
    clean = gradients(heads, latents, cotangent)
    with torch.no_grad():
        parts = heads.state_dict()
        (latents, *parts.values())[index][17].fill_(poison)
        heads.load_state_dict(parts)
    poisoned = gradients(heads, latents, cotangent)
    others = [g for g in range(40) if g != 17]
    assert all(torch.equal(poisoned[name][others], value[others]) for name, value in clean.items())
    assert not bool(poisoned["offsets"][17].isfinite().all()) or not bool(poisoned["latents"][17].isfinite().all())
    if poison != poison:
        exact = gradients(in_float64(heads), latents.double(), cotangent.double())
        assert all(torch.equal(poisoned[name].isnan(), value.isnan()) for name, value in exact.items())


def test_extreme_diagonals() -> None:
    """exp as the processor's own, over all that a float can hold."""
    heads = HyperHeads(4001, 1)
    parts = heads.state_dict()
    parts["position.lower"][:, 0, 0] = diagonals = torch.linspace(-95, 95, 4001)
    parts["position.cross"].fill_(1.0)
    heads.load_state_dict(parts)
    latents = torch.ones(4001, 1)
    found = -heads(latents)[:, 0].detach()
    expected = torch.exp(-diagonals.double())
    normal = (expected > 1.2e-38) & (expected < 3.4e38)
    assert int(normal.sum()) > 3700
    torch.testing.assert_close(found[normal].double(), expected[normal], rtol=3e-7, atol=0)
    assert bool((found[expected >= 3.5e38] == torch.inf).all())
    assert bool((found[expected <= 1.1e-38].double() - expected[expected <= 1.1e-38]).abs().max() <= 1.5e-45)


@pytest.mark.parametrize("n", [1, 2, 7, 8, 33])
@pytest.mark.parametrize("num", [0, 1, 500])
def test_folded_heads_are_the_heads(num: int, n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    heads, latents = random_heads(num, n), torch.randn(num, n)
    exact, wide = in_float64(heads), latents.double()
    torch.testing.assert_close(exact.fold()(wide), exact(wide).detach(), rtol=1e-12, atol=1e-12)
    folded = heads.fold()
    found = folded(latents)
    assert not found.requires_grad
    torch.testing.assert_close(found.double(), exact(wide).detach(), **TOLERANCE)
    for threads in "125":
        for simd in available_simd():
            monkeypatch.setenv("AVATAR_THREADS", threads)
            monkeypatch.setenv("AVATAR_SIMD", simd)
            assert torch.equal(folded(latents), found)
    strided = latents.T.contiguous().T
    assert torch.equal(folded(strided), found)


def test_folded_heads_do_not_follow_the_heads() -> None:
    heads, latents = random_heads(5, 2), torch.randn(5, 2)
    folded = heads.fold()
    before = folded(latents)
    with torch.no_grad():
        heads.packed.add_(1.0)
    assert torch.equal(folded(latents), before)


@pytest.mark.usefixtures("any_shapes")
def test_folded_heads_refuse_latents_of_other_gaussians() -> None:
    with pytest.raises(ValueError, match="matrix has N = 5, but latents has N = 4; they must be the same"):
        random_heads(5, 2).fold()(torch.randn(4, 2))


@pytest.mark.usefixtures("any_shapes")
def test_wrong_tensors_are_named() -> None:
    heads = random_heads(5, 4)
    with pytest.raises(ValueError, match=r"latents must have shape \[N, n\], got \[4\]"):
        heads(torch.zeros(4))
    with pytest.raises(ValueError, match=r"packed must have shape \[1, 84, 16\], got \[2, 84, 16\]"):
        condition(torch.zeros(5, 4), torch.zeros(2, 84, 16))
    with pytest.raises(ValueError, match=r"packed must have shape \[1, 71, 16\], got \[1, 84, 16\]"):
        heads(torch.zeros(5, 3))
    with pytest.raises(TypeError, match="packed must be float32 on the cpu, got torch.float64 on cpu"):
        condition(torch.zeros(5, 4), heads.packed.double())
    with pytest.raises(TypeError, match="latents must be float32 on the cpu, got torch.float64 on cpu"):
        condition(torch.zeros(5, 4, dtype=torch.float64), heads.packed)


def test_a_second_backward_accumulates() -> None:
    heads, latents = random_heads(20, 3), torch.randn(20, 3)
    for _ in range(2):
        heads(latents).sum().backward()
    once = gradients(heads, latents, torch.ones(20, 10))
    assert heads.packed.grad is not None
    for name, value in by_part(heads.packed.grad, 20).items():
        torch.testing.assert_close(value, 2 * once[name], rtol=1e-6, atol=1e-6)
