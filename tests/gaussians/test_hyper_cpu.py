"""The compiled operator against the definition in avatar.gaussians.hyper, in float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avatar.bench.machine import available_simd
from avatar.gaussians.hyper import HyperHeads
from avatar.gaussians.hyper_cpu import condition

TOLERANCE = {"rtol": 2e-5, "atol": 2e-5}  # sums of up to 128 products in float32


def random_heads(num: int, n: int, seed: int = 0) -> HyperHeads:
    generator = torch.Generator().manual_seed(seed)
    heads = HyperHeads(num, n)
    with torch.no_grad():
        for parameter in heads.parameters():
            parameter.copy_(0.4 * torch.randn(parameter.shape, generator=generator))
    return heads


def in_float64(heads: HyperHeads) -> HyperHeads:
    exact = HyperHeads(len(heads.position.mean), heads.position.latent_size).double()
    exact.load_state_dict(heads.state_dict())
    return exact


def gradients(heads: HyperHeads, latents: Tensor, cotangent: Tensor) -> dict[str, Tensor]:
    """The offsets and all gradients, by name."""
    leaf = latents.detach().requires_grad_()
    offsets = heads(leaf)
    names = [name for name, _ in heads.named_parameters()]
    found = torch.autograd.grad(offsets, (leaf, *heads.parameters()), cotangent)
    return {"offsets": offsets.detach(), **dict(zip(("latents", *names), found, strict=True))}


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
    heads.rotation.lower.requires_grad_()
    heads(latents).backward(cotangent)
    assert {name for name, p in heads.named_parameters() if p.grad is not None} == {"rotation.lower"}
    assert heads.rotation.lower.grad is not None
    assert torch.equal(heads.rotation.lower.grad, everything["rotation.lower"])
    heads.requires_grad_(False)
    assert not heads(latents).requires_grad
    with torch.no_grad():
        assert torch.equal(heads(leaf), everything["offsets"])


def test_strided_tensors() -> None:
    heads, latents, cotangent = random_heads(30, 6), torch.randn(6, 30), torch.randn(10, 30)
    found = gradients(heads, latents.T, cotangent.T)
    expected = gradients(heads, latents.T.contiguous(), cotangent.T.contiguous())
    assert all(torch.equal(found[name], value) for name, value in expected.items())
    strided = [p.detach().transpose(0, 1).contiguous().transpose(0, 1) for p in parameters_of(heads)]
    assert not any(p.is_contiguous() for p in strided)
    assert torch.equal(condition(latents.T, strided), found["offsets"])


def parameters_of(heads: HyperHeads) -> list[Tensor]:
    return [t for head in (heads.position, heads.rotation, heads.scale) for t in (head.mean, head.lower, head.cross)]


@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
@pytest.mark.parametrize("index", range(10))
def test_what_is_not_finite_shows_and_stays_with_its_gaussian(index: int, poison: float) -> None:
    heads, latents, cotangent = random_heads(40, 9), torch.randn(40, 9), torch.randn(40, 10)
    clean = gradients(heads, latents, cotangent)
    with torch.no_grad():
        (latents, *parameters_of(heads))[index][17].fill_(poison)
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
    with torch.no_grad():
        heads.position.lower[:, 0, 0] = torch.linspace(-95, 95, 4001)
        heads.position.cross.fill_(1.0)
    latents = torch.ones(4001, 1)
    found = -heads(latents)[:, 0].detach()
    expected = torch.exp(-heads.position.lower[:, 0, 0].detach().double())
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
        heads.position.mean.add_(1.0)
    assert torch.equal(folded(latents), before)
    with pytest.raises(ValueError, match="matrix has N = 5, but latents has N = 4; they must be the same"):
        folded(latents[:4])


def test_wrong_tensors_are_named() -> None:
    heads = random_heads(5, 4)
    with pytest.raises(ValueError, match=r"latents must have shape \[N, n\], got \[4\]"):
        heads(torch.zeros(4))
    with pytest.raises(ValueError, match=r"position.mean must have shape \[6, 7\] for these latents, got \[5, 7\]"):
        heads(torch.zeros(6, 4))
    with pytest.raises(ValueError, match=r"position.mean must have shape \[5, 6\] for these latents, got \[5, 7\]"):
        heads(torch.zeros(5, 3))
    parameters = parameters_of(heads)
    with pytest.raises(TypeError, match="rotation.cross must be float32 on the cpu, got torch.float64 on cpu"):
        condition(torch.zeros(5, 4), [*parameters[:5], parameters[5].double(), *parameters[6:]])
    with pytest.raises(TypeError, match="latents must be float32 on the cpu, got torch.float64 on cpu"):
        condition(torch.zeros(5, 4, dtype=torch.float64), parameters)


def test_checkpoints_keep_their_names_and_shapes() -> None:
    assert {name: tuple(value.shape) for name, value in HyperHeads(6, 5).state_dict().items()} == {
        f"{head}.{name}": shape
        for head, m in (("position", 3), ("rotation", 4), ("scale", 3))
        for name, shape in (("mean", (6, m + 5)), ("lower", (6, m, m)), ("cross", (6, 5, m)))
    }


def test_a_second_backward_accumulates() -> None:
    heads, latents = random_heads(20, 3), torch.randn(20, 3)
    for _ in range(2):
        heads(latents).sum().backward()
    once = gradients(heads, latents, torch.ones(20, 10))
    for name, parameter in heads.named_parameters():
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, 2 * once[name], rtol=1e-6, atol=1e-6)
