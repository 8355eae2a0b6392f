"""The compiled composition against the plain one in float64: values, gradients, threads, instruction sets, extremes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avatar.gaussians.apply_offsets import apply_offsets
from avatar.gaussians.apply_offsets_cpu import apply_offsets_cpu

NAMES = ("points", "quats", "log_scales", "opacity_logits", "raw")
ULP = 2.0**-23  # the spacing of float32 at 1


def parameters(N: int) -> list[Tensor]:
    return [
        0.1 * torch.randn(N, 3),
        torch.randn(N, 4),
        -6 + torch.randn(N, 3),
        3 * torch.randn(N),
        1.5 * torch.randn(N, 10),
    ]


def upstream(N: int) -> list[Tensor]:
    return [torch.randn(N, 3), torch.randn(N, 4), torch.randn(N, 3), torch.randn(N)]


def plain(points: Tensor, quats: Tensor, log_scales: Tensor, opacity_logits: Tensor, raw: Tensor) -> tuple[Tensor, ...]:
    sh = points.new_zeros(len(points), 1, 3)
    return apply_offsets(points, quats, log_scales, opacity_logits, sh, raw)[:4]


def values_and_gradients(function, inputs: list[Tensor], grads: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    outputs = function(*inputs)
    return [tensor.detach() for tensor in outputs], list(torch.autograd.grad(outputs, inputs, grads))


def assert_like_the_oracle(inputs: list[Tensor], grads: list[Tensor]) -> None:
    doubles = [[tensor.double() for tensor in tensors] for tensors in (inputs, grads)]
    outputs, gradients = values_and_gradients(apply_offsets_cpu, inputs, grads)
    expected, expected_gradients = values_and_gradients(plain, *doubles)
    (means, quats, scales, opacities), (true_means, true_quats, true_scales, true_opacities) = outputs, expected
    assert ((means - true_means).abs() <= 2 * ULP * true_means.abs().clamp(min=1)).all()
    assert ((quats - true_quats).abs() <= 4 * ULP).all()
    # A relative error of the exponent's argument is an absolute one of the logarithm.
    assert ((scales - true_scales).abs() <= true_scales * ULP * (2 + 4 * true_scales.log().abs())).all()
    assert ((opacities - true_opacities).abs() <= 2 * ULP * true_opacities).all()
    for name, gradient, true in zip(NAMES, gradients, expected_gradients, strict=True):
        assert gradient.dtype == torch.float32
        assert (gradient - true).norm() <= 1e-6 * true.norm(), name


@pytest.mark.parametrize("N", [1, 3, 63, 64, 65, 1000, 2049])
def test_values_and_gradients_agree_with_float64(N: int) -> None:
    assert_like_the_oracle(parameters(N), upstream(N))


@pytest.mark.parametrize("name", ["baseline", "avx2", "avx512"])
def test_every_instruction_set(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_SIMD", name)
    try:
        apply_offsets_cpu(*parameters(1))
    except ValueError as error:
        pytest.skip(str(error))
    assert_like_the_oracle(parameters(777), upstream(777))


def test_tanh_over_its_whole_range() -> None:
    """Means on points at the origin are the tanh itself."""
    raw = torch.zeros(30_000, 10)
    ranges = (torch.linspace(-12, 12, 30_000), torch.linspace(0.6, 0.65, 30_000), torch.logspace(-30, 2, 30_000))
    raw[:, :3] = torch.stack(ranges, -1)
    points, quats, log_scales, logits, _ = parameters(30_000)
    means, *_ = apply_offsets_cpu(torch.zeros_like(points), quats, log_scales, logits, raw)
    true = torch.tanh(raw[:, :3].double())
    assert ((means - true).abs() <= 2 * ULP * true.abs()).all()


def test_sigmoid_and_exponential_over_their_whole_range() -> None:
    """Opacities and, without offsets, scales; down to the smallest normal number."""
    x = torch.linspace(-87, 88, 50_000)
    points, quats, _, _, raw = parameters(50_000)
    _, _, scales, opacities = apply_offsets_cpu(points, quats, x[:, None].repeat(1, 3), x, torch.zeros_like(raw))
    assert ((opacities - torch.sigmoid(x.double())).abs() <= 2 * ULP * torch.sigmoid(x.double())).all()
    true = torch.exp(x.double())[:, None]
    assert ((scales - true).abs() <= 2 * ULP * true).all()


def test_extremes_saturate() -> None:
    points, quats, log_scales, logits, raw = parameters(4)
    raw = torch.tensor([-torch.inf, -1e30, 1e30, torch.inf])[:, None].repeat(1, 10)
    logits = torch.tensor([-torch.inf, -200.0, 200.0, torch.inf])
    log_scales[:, 0] = torch.tensor([-1e30, -1000.0, 200.0, 1e30])
    means, _, scales, opacities = apply_offsets_cpu(points, quats, log_scales, logits, raw)
    assert torch.equal(means, points + torch.tensor([-1.0, -1.0, 1.0, 1.0])[:, None])
    assert torch.equal(opacities, torch.tensor([0.0, 0.0, 1.0, 1.0]))
    assert torch.equal(scales[:, 0], torch.tensor([0.0, 0.0, torch.inf, torch.inf]))


def test_quaternions_of_any_length() -> None:
    """Normalised as torch does it, with 1e-12 as the smallest divisor."""
    points, quats, log_scales, logits, raw = parameters(6)
    quats *= torch.tensor([0.0, 1e-14, 1e-11, 1e-6, 1.0, 1e8])[:, None] / quats.norm(dim=-1, keepdim=True)
    inputs, grads = [points, quats, log_scales, logits, raw], upstream(6)
    _, gradients = values_and_gradients(apply_offsets_cpu, inputs, grads)
    doubles = [tensor.double() for tensor in inputs]
    outputs, expected = values_and_gradients(plain, doubles, [grad.double() for grad in grads])
    torch.testing.assert_close(gradients[1], expected[1].float(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(apply_offsets_cpu(*inputs)[1], outputs[1].float())


@pytest.mark.parametrize("which", range(5), ids=NAMES)
def test_a_nan_stays_in_its_gaussian_and_is_seen(which: int) -> None:
    inputs = parameters(70)
    clean = apply_offsets_cpu(*inputs)
    inputs[which][66] = torch.nan
    poisoned = apply_offsets_cpu(*inputs)
    assert any(bool(tensor[66].isnan().any()) for tensor in poisoned)
    others = torch.arange(70) != 66
    assert all(torch.equal(one[others], other[others]) for one, other in zip(clean, poisoned, strict=True))


def test_same_bits_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, grads = parameters(5001), upstream(5001)
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setenv("AVATAR_THREADS", str(threads))
        outputs, gradients = values_and_gradients(apply_offsets_cpu, inputs, grads)
        results.append(outputs + gradients)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_what_is_not_used_or_not_contiguous() -> None:
    """Only the opacities go into the loss, and the offsets are a transposed tensor; the points have no gradient."""
    points, quats, log_scales, logits, raw = parameters(20)
    logits.requires_grad_()
    strided = raw.T.contiguous().T.requires_grad_()
    means, _, _, opacities = apply_offsets_cpu(points, quats, log_scales, logits, strided)
    assert torch.equal(means, apply_offsets_cpu(points, quats, log_scales, logits, raw)[0])
    opacities.sum().backward()
    assert strided.grad is not None and not strided.grad.any()
    torch.testing.assert_close(logits.grad, (opacities * (1 - opacities)).detach())


def test_apply_offsets_takes_the_kernel_for_float32_only() -> None:
    inputs = parameters(30)
    sh = torch.randn(30, 16, 3)
    activated = apply_offsets(*inputs[:4], sh, inputs[4])
    assert activated.sh is sh
    assert all(torch.equal(a, b) for a, b in zip(activated[:4], apply_offsets_cpu(*inputs), strict=True))
    doubles = [tensor.double() for tensor in inputs]
    exact = apply_offsets(*doubles[:4], sh.double(), doubles[4])
    assert all(torch.equal(a, b) for a, b in zip(exact[:4], plain(*doubles), strict=True))


@pytest.mark.usefixtures("any_shapes")
def test_sizes_that_disagree_are_named() -> None:
    points, quats, log_scales, logits, raw = parameters(8)
    with pytest.raises(ValueError, match=r"raw has N = 7, but points has N = 8"):
        apply_offsets(points, quats, log_scales, logits, torch.zeros(8, 16, 3), raw[:7])
