"""The HyperGaussian heads' time and error: the compiled operator against four ways of writing them in torch.

Every way holds the parameters as suits it, the compiled operator packed and the others as a tensor for each part, and is
compared with float64 before it is timed. The floor is the time in which the machine copies what an operator must move at
least: the packed parameters and the latents are read in the forward pass and once more in the backward pass, and as many
gradients are written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from avatar.bench.clock import Time, paired_medians
from avatar.errors import UserError
from avatar.gaussians.hyper import Heads, HyperHead, HyperHeads, unpack
from avatar.gaussians.hyper_cpu import HEADS, condition
from avatar.splat.scenes import HEAD_SPLATS

LATENT_SIZES, QUICK_LATENT_SIZES = (1, 2, 4, 8, 16, 32, 64, 128), (1, 8)
COVARIANCE_FLOATS = 6_000_000  # of one head's covariances; it is timed on as many Gaussians as have these
TOLERANCE = 1e-5  # sums of 128 products in float32
COVARIANCE_TOLERANCE = 1e-3  # through the inverse of a matrix of 128 rows

Leaves = dict[str, Tensor]


@dataclass(frozen=True)
class Method:
    offsets: Callable[[Leaves], Tensor]  # [N, 10]
    leaves: Callable[[HyperHeads], Leaves]


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
    ways: Mapping[str, Method] | None = None,
) -> list[Row]:
    """Verify and time every way; those of the same parameters take turns. UserError for a wrong one."""
    rows: list[Row] = []
    for n in latent_sizes:
        print(f"{n} latent dimensions")
        few = min(count, COVARIANCE_FLOATS // (4 + n) ** 2)
        rows += compare(ways or WAYS, by_substitution, random_heads(count, n), repeats, TOLERANCE)
        covariance = {"covariance": Method(by_covariance, covariance_leaves)}
        rows += compare(covariance, by_covariance, random_heads(few, n), min(repeats, 5), COVARIANCE_TOLERANCE)
    return rows


def compare(
    ways: Mapping[str, Method],
    truth: Callable[[Leaves], Tensor],
    heads: HyperHeads,
    repeats: int,
    tolerance: float,
) -> list[Row]:
    """The ways in turns, each against `truth` in float64 on the same parameters."""
    N, n = heads.num_gaussians, heads.latent_size
    cotangent = torch.randn(N, 10, generator=torch.Generator().manual_seed(2))
    packed = packed_leaves(heads)
    source = torch.cat([leaf.detach().reshape(-1) for leaf in packed.values()])
    target = torch.empty_like(source)
    calls: dict[tuple[str, str], Callable[[], object]] = {("copy", ""): lambda: target.copy_(source)}
    errors = {}
    for name, way in ways.items():
        leaves = way.leaves(heads)
        errors[name] = verify(name, way, leaves, cotangent, truth, tolerance)
        calls |= {(name, part): call for part, call in passes_of(way, leaves, cotangent).items()}
    times = paired_medians(calls, repeats)
    floor = 1.5 * times["copy", ""].median  # a copy reads and writes once: 3 passes to its 2
    return [
        Row(
            way=name,
            latent_size=n,
            gaussians=N,
            offsets_error=offsets,
            gradient_error=gradients,
            forward=times[name, "forward"],
            backward=times[name, "backward"],
            floor=None if ways[name].leaves is covariance_leaves else floor,
        )
        for name, (offsets, gradients) in errors.items()
    ]


def verify(
    name: str, way: Method, leaves: Leaves, cotangent: Tensor, truth: Callable[[Leaves], Tensor], tolerance: float
) -> tuple[float, float]:
    """The errors of offsets and gradients; UserError if they are above the tolerance."""
    found = way.offsets(leaves)
    gradients = torch.autograd.grad(found, list(leaves.values()), cotangent)
    by_part = parts_of(dict(zip(leaves, gradients, strict=True)))
    exact = {part: leaf.detach().double().requires_grad_() for part, leaf in parts_of(leaves).items()}
    true_offsets = truth(exact)
    true_gradients = torch.autograd.grad(true_offsets, list(exact.values()), cotangent.double())
    offsets = float((found.detach() - true_offsets.detach()).abs().max() / true_offsets.detach().abs().max())
    gradient = max(float((by_part[part] - b).norm() / b.norm()) for part, b in zip(exact, true_gradients, strict=True))
    if not (offsets <= tolerance and gradient <= tolerance):  # not: a NaN is wrong too
        raise UserError(
            f"{name} with {leaves['latents'].shape[1]} latent dimensions is wrong, so it is not timed: its offsets are off "
            f"by {offsets:.1e} and its gradients by {gradient:.1e} (at most {tolerance:.0e})"
        )
    return offsets, gradient


def passes_of(way: Method, leaves: Leaves, cotangent: Tensor) -> dict[str, Callable[[], object]]:
    """The forward pass, and the backward pass of what the forward pass made last."""
    made: list[Tensor] = []
    inputs = list(leaves.values())

    def forward() -> None:
        made[:] = [way.offsets(leaves)]

    def backward() -> object:
        return torch.autograd.grad(made.pop(), inputs, cotangent)

    return {"forward": forward, "backward": backward}


def random_heads(count: int, n: int) -> HyperHeads:
    """Heads and gradients of usual sizes: cross terms shrink with n, as the sums over them would grow."""
    generator = torch.Generator().manual_seed(0)
    heads = HyperHeads(count, n)
    with torch.no_grad():
        heads.packed.copy_(0.3 * torch.randn(heads.packed.shape, generator=generator))
    heads.set_heads({name: head._replace(cross=head.cross / n**0.5) for name, head in heads.heads().items()})
    return heads


def random_latents(heads: HyperHeads) -> Tensor:
    shape = heads.num_gaussians, heads.latent_size
    return torch.randn(shape, generator=torch.Generator().manual_seed(1)).requires_grad_()


def packed_leaves(heads: HyperHeads) -> Leaves:
    return {"latents": random_latents(heads), "packed": heads.packed}


def separate_leaves(heads: HyperHeads) -> Leaves:
    parts = {name: part.clone().requires_grad_() for name, part in heads.state_dict().items()}
    return {"latents": random_latents(heads), **parts}


def covariance_leaves(heads: HyperHeads) -> Leaves:
    """The same distributions as mean and covariance factor, with the identity for what the conditional lacks (L22)."""
    n = heads.latent_size
    leaves = {"latents": random_latents(heads)}
    with torch.no_grad():
        for name, head in heads.heads().items():
            m, factor = HEADS[name], head.factor()
            precision = torch.eye(m + n, dtype=torch.float64).repeat(heads.num_gaussians, 1, 1)
            precision[:, :m, :m], precision[:, m:, :m] = factor.L11, factor.L21
            # (L L^T)^-1 = L^-T L^-1; its lower triangular factor.
            inverse = torch.linalg.solve_triangular(precision, torch.eye(m + n, dtype=torch.float64), upper=False)
            leaves[f"{name}.mean"] = head.mean.detach().clone().requires_grad_()
            leaves[f"{name}.factor"] = torch.linalg.cholesky(inverse.mT @ inverse).float().requires_grad_()
    return leaves


def parts_of(leaves: Leaves) -> Leaves:
    """The same with the packed tensor, if there is one, taken apart."""
    if "packed" not in leaves:
        return leaves
    heads = unpack(leaves["packed"], len(leaves["latents"]))
    parts = {f"{name}.{part}": value for name, head in heads.items() for part, value in head._asdict().items()}
    return {"latents": leaves["latents"], **parts}


def heads_of(leaves: Leaves) -> Heads:
    return {name: HyperHead(*(leaves[f"{name}.{part}"] for part in HyperHead._fields)) for name in HEADS}


def fused(leaves: Leaves) -> Tensor:
    return condition(leaves["latents"], leaves["packed"])


def by_substitution(leaves: Leaves) -> Tensor:
    """The definition, operation by operation."""
    return torch.cat([head.conditional_mean(leaves["latents"]) for head in heads_of(leaves).values()], dim=-1)


def by_solve_triangular(leaves: Leaves) -> Tensor:
    """The same with torch's batched solver, for one vector of each Gaussian."""
    offsets = []
    for head in heads_of(leaves).values():
        (mean_a, mean_b), (L11, L21) = head.means(), head.factor()
        pulled = L21.mT @ (leaves["latents"] - mean_b)[..., None]
        offsets.append(mean_a - torch.linalg.solve_triangular(L11.mT, pulled, upper=True).squeeze(-1))
    return torch.cat(offsets, dim=-1)


def by_slope(leaves: Leaves) -> Tensor:
    """As the paper writes it: torch's batched solver for the matrix L11^-T L21^T, then its product with the latent."""
    offsets = []
    for head in heads_of(leaves).values():
        (mean_a, mean_b), (L11, L21) = head.means(), head.factor()
        slope = torch.linalg.solve_triangular(L11.mT, L21.mT, upper=True)
        offsets.append(mean_a - (slope @ (leaves["latents"] - mean_b)[..., None]).squeeze(-1))
    return torch.cat(offsets, dim=-1)


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


WAYS: dict[str, Method] = {
    "fused": Method(fused, packed_leaves),
    "substitution": Method(by_substitution, separate_leaves),
    "solve_triangular": Method(by_solve_triangular, separate_leaves),
    "slope": Method(by_slope, separate_leaves),
}
