"""The HyperGaussian heads' time and error: the compiled operator against three ways of writing them in torch.

Every way is compared with float64 before it is timed. The floor is the time in which the machine copies what an operator
must move at least: the parameters and latents are read in the forward pass and once more in the backward pass, and as many
gradients are written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from avatar.bench.clock import Time, paired_medians
from avatar.bench.scenes import HEAD_SPLATS
from avatar.errors import UserError
from avatar.gaussians.hyper import Factor, HyperHeads, conditional_mean, factor_of
from avatar.gaussians.hyper_cpu import HEADS, condition

LATENT_SIZES, QUICK_LATENT_SIZES = (1, 2, 4, 8, 16, 32, 64, 128), (1, 8)
COVARIANCE_FLOATS = 6_000_000  # of one head's covariances; it is timed on as many Gaussians as have these
TOLERANCE = 1e-5  # sums of 128 products in float32
COVARIANCE_TOLERANCE = 1e-3  # through the inverse of a matrix of 128 rows

Leaves = dict[str, Tensor]
Way = Callable[[Leaves], Tensor]  # to the offsets [N, 10]


@dataclass(frozen=True)
class Row:
    way: str
    latent_size: int
    gaussians: int
    offsets_error: float  # largest difference to float64, over the largest offset
    gradient_error: float  # largest of the tensors' ||difference|| / ||gradient||
    forward: Time
    backward: Time
    floor: float | None  # milliseconds; of the ways that hold the heads' own parameters


def measure(
    latent_sizes: Sequence[int] = LATENT_SIZES,
    *,
    count: int = HEAD_SPLATS,
    repeats: int = 21,
    ways: Mapping[str, Way] | None = None,
    say: Callable[[str], None] = print,
) -> list[Row]:
    """Verify and time every way; those of the same parameters take turns. UserError for a wrong one."""
    rows: list[Row] = []
    for n in latent_sizes:
        say(f"{n} latent dimensions")
        few = min(count, COVARIANCE_FLOATS // (4 + n) ** 2)
        heads = random_heads(count, n)
        rows += compare(ways or WAYS, leaves_of(heads), repeats, TOLERANCE, with_floor=True)
        some = covariance_leaves(random_heads(few, n))
        rows += compare({"covariance": by_covariance}, some, min(repeats, 5), COVARIANCE_TOLERANCE, with_floor=False)
    return rows


def compare(ways: Mapping[str, Way], leaves: Leaves, repeats: int, tolerance: float, *, with_floor: bool) -> list[Row]:
    N, n = leaves["latents"].shape
    cotangent = torch.randn(N, 10, generator=torch.Generator().manual_seed(2))
    exact = {name: leaf.detach().double().requires_grad_() for name, leaf in leaves.items()}
    truth = (by_substitution if with_floor else by_covariance)(exact)
    gradients = torch.autograd.grad(truth, list(exact.values()), cotangent.double())
    errors = {name: verify(name, way, leaves, cotangent, truth, gradients, tolerance) for name, way in ways.items()}

    source = torch.cat([leaf.detach().reshape(-1) for leaf in leaves.values()])
    target = torch.empty_like(source)
    calls: dict[tuple[str, str], Callable[[], object]] = {("copy", ""): lambda: target.copy_(source)}
    for name, way in ways.items():
        calls |= {(name, part): call for part, call in passes_of(way, leaves, cotangent).items()}
    times = paired_medians(calls, repeats)
    floor = 1.5 * times["copy", ""].median if with_floor else None  # a copy reads and writes once: 3 passes to its 2
    return [Row(name, n, N, *errors[name], times[name, "forward"], times[name, "backward"], floor) for name in ways]


def verify(
    name: str,
    way: Way,
    leaves: Leaves,
    cotangent: Tensor,
    truth: Tensor,
    gradients: Sequence[Tensor],
    tolerance: float,
) -> tuple[float, float]:
    """The errors of offsets and gradients; UserError if they are above the tolerance."""
    found = way(leaves)
    found_gradients = torch.autograd.grad(found, list(leaves.values()), cotangent)
    offsets = float((found.detach() - truth.detach()).abs().max() / truth.detach().abs().max())
    gradient = max(float((a - b).norm() / b.norm()) for a, b in zip(found_gradients, gradients, strict=True))
    if not (offsets <= tolerance and gradient <= tolerance):  # not: a NaN is wrong too
        raise UserError(
            f"{name} with {leaves['latents'].shape[1]} latent dimensions is wrong, so it is not timed: its offsets are off "
            f"by {offsets:.1e} and its gradients by {gradient:.1e} (at most {tolerance:.0e})"
        )
    return offsets, gradient


def passes_of(way: Way, leaves: Leaves, cotangent: Tensor) -> dict[str, Callable[[], object]]:
    """The forward pass, and the backward pass of what the forward pass made last."""
    made: list[Tensor] = []
    inputs = list(leaves.values())

    def forward() -> None:
        made[:] = [way(leaves)]

    def backward() -> object:
        return torch.autograd.grad(made.pop(), inputs, cotangent)

    return {"forward": forward, "backward": backward}


def random_heads(count: int, n: int) -> HyperHeads:
    """Heads and gradients of usual sizes: cross terms shrink with n, as the sums over them would grow."""
    generator = torch.Generator().manual_seed(0)
    heads = HyperHeads(count, n)
    with torch.no_grad():
        for name, parameter in heads.named_parameters():
            size = 0.3 / n**0.5 if name.endswith("cross") else 0.3
            parameter.copy_(size * torch.randn(parameter.shape, generator=generator))
    return heads


def random_latents(count: int, n: int) -> Tensor:
    return torch.randn(count, n, generator=torch.Generator().manual_seed(1)).requires_grad_()


def leaves_of(heads: HyperHeads) -> Leaves:
    count, n = len(heads.position.mean), heads.position.latent_size
    return {"latents": random_latents(count, n), **dict(heads.named_parameters())}


def covariance_leaves(heads: HyperHeads) -> Leaves:
    """The same distributions as mean and covariance factor, with the identity for what the conditional lacks (L22)."""
    count, n = len(heads.position.mean), heads.position.latent_size
    leaves = {"latents": random_latents(count, n)}
    with torch.no_grad():
        for name, m in HEADS.items():
            head = getattr(heads, name)
            factor = head.factor()
            precision = torch.eye(m + n, dtype=torch.float64).repeat(count, 1, 1)
            precision[:, :m, :m], precision[:, m:, :m] = factor.L11, factor.L21
            # (L L^T)^-1 = L^-T L^-1; its lower triangular factor.
            inverse = torch.linalg.solve_triangular(precision, torch.eye(m + n, dtype=torch.float64), upper=False)
            leaves[f"{name}.mean"] = head.mean.detach().clone()
            leaves[f"{name}.factor"] = torch.linalg.cholesky(inverse.mT @ inverse).float()
    return {name: leaf.requires_grad_() for name, leaf in leaves.items()}


def fused(leaves: Leaves) -> Tensor:
    latents, *parameters = leaves.values()
    return condition(latents, parameters)


def by_substitution(leaves: Leaves) -> Tensor:
    """The definition, operation by operation."""
    latents = leaves["latents"]
    return torch.cat([conditional_mean(*head, latents) for head in parts_of(leaves)], dim=-1)


def by_solve_triangular(leaves: Leaves) -> Tensor:
    """The same with torch's batched solver."""
    offsets = []
    for mean_a, mean_b, (L11, L21) in parts_of(leaves):
        pulled = L21.mT @ (leaves["latents"] - mean_b)[..., None]
        offsets.append(mean_a - torch.linalg.solve_triangular(L11.mT, pulled, upper=True).squeeze(-1))
    return torch.cat(offsets, dim=-1)


def parts_of(leaves: Leaves) -> Iterator[tuple[Tensor, Tensor, Factor]]:
    n = leaves["latents"].shape[1]
    for head, m in HEADS.items():
        mean_a, mean_b = leaves[f"{head}.mean"].split((m, n), dim=-1)
        yield mean_a, mean_b, factor_of(leaves[f"{head}.lower"], leaves[f"{head}.cross"])


def by_covariance(leaves: Leaves) -> Tensor:
    """The textbook: Sigma = F F^T, then mu_a + Sigma_ab Sigma_bb^-1 (z - mu_b)."""
    offsets = []
    for head, m in HEADS.items():
        mean, F = leaves[f"{head}.mean"], leaves[f"{head}.factor"]
        covariance = F @ F.mT
        difference = (leaves["latents"] - mean[:, m:])[..., None]
        solved = torch.linalg.solve(covariance[:, m:, m:], difference)
        offsets.append(mean[:, :m] + (covariance[:, :m, m:] @ solved).squeeze(-1))
    return torch.cat(offsets, dim=-1)


WAYS: dict[str, Way] = {
    "fused": fused,
    "substitution": by_substitution,
    "solve_triangular": by_solve_triangular,
}
