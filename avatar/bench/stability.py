"""Error of a HyperGaussian's conditional mean against the condition number of its covariance, for two ways to find it.

The joint distribution of an attribute a (3 values) and a latent b (n values) is drawn with a given condition number. The
inverse-covariance trick takes two blocks of the precision matrix's Cholesky factor (`avatar.gaussians.hyper`), the direct
form takes the covariance, E[a | b] = mu_a + S_ab S_bb^-1 (b - mu_b). Each gets its own parameters, rounded to its own
precision, as a program that stores them would; the truth comes from the unrounded factor in float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.bench import Request
from avatar.bench.results import Line, Panel, write_report
from avatar.gaussians.hyper import Factor, conditional_mean

ATTRIBUTE = 3  # values of a, as of a position
LATENTS = (1, 2, 4, 8, 16, 32, 64, 128)
CONDITIONS = tuple(10.0**k for k in range(13))
FAILED = 0.01  # relative error
FORMS = ("trick float32", "direct float32", "direct float64")


@dataclass(frozen=True)
class Row:
    form: str  # of FORMS
    latent: int  # n
    condition: float
    median: float  # of the relative errors of all Gaussians
    worst: float


def run(request: Request) -> None:
    """Measure, print and write stability.json, stability.md and stability.png."""
    count = 16 if request.quick else 1000 if request.full else 200
    rows = measure(LATENTS[:4] if request.quick else LATENTS, CONDITIONS, count)
    found = {"gaussians": count, "rows": [asdict(row) for row in rows]}
    write_report(request.out, "stability", table(rows), found, panels(rows))


def measure(latents: Sequence[int], conditions: Sequence[float], count: int) -> list[Row]:
    rows = []
    for n in latents:
        for condition in conditions:
            generator = torch.Generator().manual_seed(n)
            L = random_factor(count, ATTRIBUTE + n, condition, generator)
            latent = torch.randn(count, n, generator=generator).double()
            truth = by_precision(L, latent, torch.float64)
            found = {
                "trick float32": by_precision(L, latent, torch.float32),
                "direct float32": by_covariance(L, latent, torch.float32),
                "direct float64": by_covariance(L, latent, torch.float64),
            }
            for form, mean in found.items():
                errors = (mean.double() - truth).norm(dim=-1) / truth.norm(dim=-1)
                rows.append(Row(form, n, condition, float(errors.median()), float(errors.max())))
    return rows


def random_factor(
    count: int, size: int, condition: float, generator: torch.Generator
) -> Float[Tensor, "count size size"]:
    """Lower Cholesky factors, float64, of precision matrices with the given condition number, randomly oriented."""
    Q, _ = torch.linalg.qr(torch.randn(count, size, size, generator=generator, dtype=torch.float64))
    half = 0.5 * torch.log10(torch.tensor(condition)).item()
    eigenvalues = torch.logspace(-half, half, size, dtype=torch.float64)
    precision = (Q * eigenvalues) @ Q.mT
    return torch.linalg.cholesky(0.5 * (precision + precision.mT))


def by_precision(L: Float[Tensor, "N s s"], latent: Float[Tensor, "N n"], dtype: torch.dtype) -> Float[Tensor, "N m"]:
    m = L.shape[1] - latent.shape[1]
    factor = Factor(L[:, :m, :m].to(dtype), L[:, m:, :m].to(dtype))
    zero_a, zero_b = latent.new_zeros(len(L), m, dtype=dtype), torch.zeros_like(latent, dtype=dtype)
    return conditional_mean(zero_a, zero_b, factor, latent.to(dtype))


def by_covariance(L: Float[Tensor, "N s s"], latent: Float[Tensor, "N n"], dtype: torch.dtype) -> Float[Tensor, "N m"]:
    m = L.shape[1] - latent.shape[1]
    # Through the factor, whose condition number is only the root of the covariance's.
    inverse = torch.linalg.solve_triangular(L, torch.eye(L.shape[1], dtype=L.dtype).expand_as(L), upper=False)
    covariance = (inverse.mT @ inverse).to(dtype)
    weights, _ = torch.linalg.solve_ex(covariance[:, m:, m:], latent.to(dtype))  # a singular matrix gives no exception
    return (covariance[:, :m, m:] @ weights[..., None])[..., 0]


def fails_at(rows: Sequence[Row], form: str, latent: int) -> float | None:
    """The smallest condition number at which the median error is over a hundredth, or is not a number."""
    own = [row for row in rows if (row.form, row.latent) == (form, latent)]
    return min((row.condition for row in own if not row.median <= FAILED), default=None)


def table(rows: Sequence[Row]) -> list[str]:
    """Median relative errors at some condition numbers, and where the form fails."""
    shown = [c for c in dict.fromkeys(row.condition for row in rows) if round(torch.tensor(c).log10().item()) % 3 == 0]
    heads = "".join(f"{f'{c:.0e}':>9}" for c in shown)
    lines = [f"{'form':>15} {'n':>4} {heads} {'worst':>9} {'over 1 % from':>14}"]
    for form in FORMS:
        for latent in dict.fromkeys(row.latent for row in rows):
            own = {row.condition: row for row in rows if (row.form, row.latent) == (form, latent)}
            medians = "".join(f"{own[c].median:9.1e}" for c in shown)
            limit = fails_at(rows, form, latent)
            worst = max(row.worst for row in own.values())
            lines.append(
                f"{form:>15} {latent:4} {medians} {worst:9.1e} {f'{limit:.0e}' if limit is not None else 'never':>14}"
            )
    return lines


def panels(rows: Sequence[Row]) -> list[Panel]:
    latents = sorted({row.latent for row in rows})
    found = []
    for latent in (n for n in (8, latents[-1]) if n in latents):
        lines = []
        for form in FORMS:
            own = [row for row in rows if (row.form, row.latent) == (form, latent)]
            lines.append(Line(form, [row.condition for row in own], [row.median for row in own]))
        found.append(Panel(f"condition number of the covariance, n = {latent}", "median relative error", lines))
    return found
