"""The paper's figure of conditioning as slicing (supplement): two Gaussians with m = n = 1, cut at several latents.

    python scripts/paper/slicing.py --out runs/paper

The conditional mean moves along the latent, the conditional variance is that of every slice. Conditioned by
`avatar.gaussians.hyper`, the definition that training uses; the densities that are drawn are evaluated from the joint
covariance, so that the figure would show if the two disagreed.
Leaves slicing.md, slicing.csv and slicing.png in --out.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch.distributions import MultivariateNormal
from write_report import run, table, write_report

from avatar.bench.results import new_figure
from avatar.gaussians.hyper import HyperHead

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LATENTS = (-1.2, 0.0, 1.2)
# log diag L11 and L21: of the precision's factor, so a larger diagonal is a narrower slice.
EXAMPLES = {"large uncertainty": (0.3, -0.8), "small uncertainty": (1.4, -2.4)}
REACH, GRID = 3.0, 201


class Slice(NamedTuple):
    example: str
    latent: float
    mean: float
    deviation: float  # standard deviation


def head_of(log_diagonal: float, cross: float) -> HyperHead:
    """One Gaussian over (attribute, latent), both means 0."""
    return HyperHead(torch.zeros(1, 2), torch.tensor([[[log_diagonal]]]), torch.tensor([[[cross]]]))


def joint(head: HyperHead) -> MultivariateNormal:
    """(attribute, latent) with the identity for the block of the precision that conditioning does not need."""
    L11, L21 = (part.double().item() for part in head.factor())
    L = torch.tensor([[L11, 0.0], [L21, 1.0]], dtype=torch.float64)
    return MultivariateNormal(head.mean[0].double(), precision_matrix=L @ L.T)


def slices(latents: Sequence[float] = LATENTS) -> list[Slice]:
    found = []
    for name, values in EXAMPLES.items():
        head = head_of(*values)
        deviation = float(torch.exp(0.5 * head.log_det_covariance()))
        found += [Slice(name, b, float(head.conditional_mean(torch.tensor([[b]]))), deviation) for b in latents]
    return found


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    found = slices()
    page = [
        "# Conditioning as slicing, m = n = 1",
        "",
        *table(
            ["Gaussian", "latent", "conditional mean", "conditional standard deviation"],
            [[s.example, f"{s.latent:g}", f"{s.mean:.3f}", f"{s.deviation:.3f}"] for s in found],
        ),
        "",
        "The mean follows the latent; the deviation is the same in every slice.",
    ]
    write_report(parser.parse_args(words).out, "slicing", page, [Slice._fields, *found], draw(found))
    return 0


def draw(found: Sequence[Slice]) -> Figure:
    """Joint density with the slices' lines; beside each, the density along its slices, normalised."""
    figure = new_figure(11, 3.4)
    line = torch.linspace(-REACH, REACH, GRID, dtype=torch.float64)
    axes = iter(figure.subplots(1, 2 * len(EXAMPLES), width_ratios=(2, 1) * len(EXAMPLES)))
    for name, values in EXAMPLES.items():
        whole, cut = next(axes), next(axes)
        distribution = joint(head_of(*values))
        b, a = torch.meshgrid(line, line, indexing="xy")
        whole.contour(
            line, line, distribution.log_prob(torch.stack((a, b), -1)).exp(), 6, colors="grey", linewidths=0.8
        )
        for index, own in enumerate(s for s in found if s.example == name):
            points = torch.stack((line, torch.full_like(line, own.latent)), -1)
            density = distribution.log_prob(points).exp()
            colour = f"C{index}"
            whole.axvline(own.latent, color=colour, lw=1)
            whole.errorbar(own.latent, own.mean, own.deviation, fmt="o", color=colour, ms=4, capsize=3)
            cut.plot(density / torch.trapezoid(density, line), line, color=colour)
            cut.axhline(own.mean, color=colour, lw=0.6, ls=":")
        whole.set(title=name, xlabel="latent $\\gamma_b$", ylabel="attribute $\\gamma_a$", ylim=(-REACH, REACH))
        cut.set(xlabel="$p(\\gamma_a|\\gamma_b)$", ylim=(-REACH, REACH), yticks=[])
    return figure


if __name__ == "__main__":
    run(main)
