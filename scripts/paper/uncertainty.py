"""Does a HyperGaussian's conditional variance say where the avatar is wrong? Maps, correlation, reliability.

    python scripts/paper/uncertainty.py FOLDER... --out runs/paper [--head HEAD] [--seeds 0 1 2] [key=value ...]
    python scripts/paper/uncertainty.py RUN... --out runs/paper

On frames that training has not seen, each pixel's squared error is compared with what three things predict for it:

    variance   the conditional variance of the Gaussians (geometric mean over their ten attributes), blended as colours are
    edges      the picture's own gradient: what needs no uncertainty at all
    training   each Gaussian's mean squared error on training frames, blended as colours are

Pixels count where the head mask does. Variance and edges have no unit; one factor gives each the mean error of the training
frames. Tracked folders are trained through `avatar sweep` in --out, as the tables do, and share their runs.
Leaves uncertainty.md, uncertainty.csv (the bins of the reliability plot) and uncertainty.png in --out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.stats import spearmanr
from systems import add_arguments, is_measured, request_of, run_of, systems, train
from torch import Tensor
from write_report import run, table, write_report

from avatar.bench.quality import held_out_frames
from avatar.bench.results import new_figure
from avatar.data.frame import Frame
from avatar.data.loader import FrameLoader
from avatar.gaussians.hyper import HyperHead
from avatar.gaussians.hyper_cpu import OFFSETS
from avatar.losses.metrics import squared_error
from avatar.pipeline.open_inputs import open_run
from avatar.runs.run import RUN_FILE, Run
from avatar.splat.sh import C0

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SYSTEM = "HyperGaussians n=8"
PREDICTORS = ("variance", "edges", "training")
BINS, WORST = 20, 0.1
MASKED, COVERED = 0.5, 0.05  # of the head mask, and of what the Gaussians cover, from which a pixel counts
ARBITRARY = 1.0  # standard deviation of the logarithm of a factor that no picture shows


@dataclass(frozen=True)
class Found:
    """What one run's predictions are worth."""

    name: str
    spearman: dict[str, float]  # of pixels of a frame, mean of the frames
    caught: dict[str, float]  # share of the squared error in the tenth of a frame's pixels with the highest prediction
    oracle: float  # the same for the error itself
    bins: dict[str, np.ndarray]  # [BINS, 2]: mean prediction and mean squared error, by rising prediction
    spread: float  # standard deviation of log10 of the Gaussians' variances
    arbitrary: tuple[float, float]  # after factors that no picture shows: change of a picture, correlation of variances
    pictures: list[np.ndarray]


@dataclass(frozen=True)
class Drawn:
    """One frame."""

    error: Tensor  # [H, W], squared, mean of the channels
    maps: dict[str, Tensor]  # [H, W] by the names in PREDICTORS
    counts: Tensor  # [H, W], bool
    truth: Tensor
    render: Tensor


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser)
    parser.add_argument("--frames", type=int, default=40, help="held-out frames, and as many of training")
    given = parser.parse_intermixed_args(words)
    request, status = request_of(given), 0
    runs = named([path for path in request.folders if (path / RUN_FILE).is_file()])
    if not runs:
        status, spec = train(request, "uncertainty.to_train", systems([SYSTEM]))
        done = [job for job in spec.jobs if is_measured(given.out, job)]
        runs = {f"{job.subject}, seed {job.seed}": run_of(given.out, job) for job in done}
    if not runs:
        return status or 1
    found = [examine(open_run(path, given.head), name, given.frames) for name, path in runs.items()]
    rows = [["run", "prediction", "mean prediction", "mean squared error"]]
    rows += [[f.name, name, *map(float, pair)] for f in found for name in PREDICTORS for pair in f.bins[name]]
    write_report(given.out, "uncertainty", page(found), rows, draw(found))
    return status


def named(paths: Sequence[Path]) -> dict[str, Path]:
    """Runs by their folders' names; those whose name another has, by their paths."""
    names = [path.name for path in paths]
    return {name if names.count(name) == 1 else str(path): path for name, path in zip(names, paths, strict=True)}


def examine(run: Run, name: str, frames: int) -> Found:
    variances = variance_of(run)
    held_out, known = held_out_frames(run, frames), training_frames(run, frames)
    errors = gaussian_errors(run, known)
    values = torch.stack((variances, errors), dim=1)
    before = [predict(run, frame, values) for frame in known]
    level = float(torch.cat([d.error[d.counts] for d in before]).mean())
    factors = {p: level / float(torch.cat([d.maps[p][d.counts] for d in before]).mean()) for p in PREDICTORS}
    factors["training"] = 1.0  # it is a squared error already
    drawn = [predict(run, frame, values) for frame in held_out]
    predictions = {p: [factors[p] * d.maps[p][d.counts].numpy() for d in drawn] for p in PREDICTORS}
    truths = [d.error[d.counts].numpy() for d in drawn]
    shown = drawn[len(drawn) // 2]
    maps = (shown.error, shown.maps["variance"], shown.maps["training"])
    return Found(
        name,
        {p: mean_over_frames(rank_correlation, predictions[p], truths) for p in PREDICTORS},
        {p: mean_over_frames(share_caught, predictions[p], truths) for p in PREDICTORS},
        mean_over_frames(share_caught, truths, truths),
        {p: reliability(np.concatenate(predictions[p]), np.concatenate(truths)) for p in PREDICTORS},
        float(variances.log10().std()),
        arbitrariness(run, held_out[0], variances),
        [shown.truth.numpy(), shown.render.clamp(0, 1).numpy(), *(np.where(shown.counts, m, np.nan) for m in maps)],
    )


def mean_over_frames(
    figure: Callable[[np.ndarray, np.ndarray], float], predictions: Sequence[np.ndarray], errors: Sequence[np.ndarray]
) -> float:
    return float(np.mean([figure(a, b) for a, b in zip(predictions, errors, strict=True)]))


@torch.no_grad()
def variance_of(run: Run) -> Tensor:
    """The conditional variance of an attribute of each Gaussian, geometric mean of its ten (supplement, eq. 3); [N]."""
    return torch.exp(run.avatar.hyper.uncertainty() / OFFSETS)


def training_frames(run: Run, count: int) -> list[Frame]:
    train = run.subject.split.train
    chosen = [train[i] for i in np.unique(np.linspace(0, len(train) - 1, count).round().astype(int))]
    with FrameLoader(run.subject, run.config.data.size) as loader:
        return list(loader.frames(chosen))


def gaussian_errors(run: Run, frames: Sequence[Frame]) -> Tensor:
    """Mean squared error of the pixels that each Gaussian paints, by how much of them it paints; [N]. 0: it paints none.

    The weights are the gradient of the picture in the Gaussians' colours.
    """
    total = torch.zeros(len(run.avatar), 2)
    for frame in frames:
        gaussians = run.trained.gaussians(frame.params, frame.camera)
        colours = torch.zeros(len(run.avatar), 1, 3, requires_grad=True)
        painted = run.avatar.draw(gaussians._replace(sh=colours), frame.camera, torch.zeros(3)).image
        error = squared_error(render(run, frame), frame.composite(run.trained.background)).float()
        mask = frame.head_mask
        (sums,) = torch.autograd.grad(painted, colours, torch.stack((error * mask, mask, torch.zeros_like(mask)), -1))
        total += sums[:, 0, :2]
    return torch.where(total[:, 1] > 0, total[:, 0] / total[:, 1].clamp(min=1e-12), 0.0)


@torch.no_grad()
def render(run: Run, frame: Frame) -> Tensor:
    return run.trained.render(frame.params, frame.camera).image


@torch.no_grad()
def predict(run: Run, frame: Frame, values: Tensor) -> Drawn:
    """`values` [N, 2]: variance and training error of each Gaussian."""
    truth, picture = frame.composite(run.trained.background), render(run, frame)
    scale = values.amax(dim=0).clamp(min=1e-12)
    colours = torch.nn.functional.pad(values / scale, (0, 1))  # within [0, 1], which the splatter does not clamp
    gaussians = run.trained.gaussians(frame.params, frame.camera)._replace(sh=((colours - 0.5) / C0)[:, None])
    blended = run.avatar.draw(gaussians, frame.camera, torch.zeros(3))
    means = blended.image[..., :2] * scale / blended.alpha.clamp(min=1e-6)[..., None]
    steps = torch.stack(torch.gradient(picture.mean(dim=-1))).square().sum(dim=0)
    maps = {"variance": means[..., 0], "training": means[..., 1], "edges": steps}
    counts = (frame.head_mask > MASKED) & (blended.alpha > COVERED)
    return Drawn(squared_error(picture, truth).float(), maps, counts, truth, picture)


def rank_correlation(prediction: np.ndarray, error: np.ndarray) -> float:
    """Spearman's; 0 for a prediction that is the same everywhere."""
    return 0.0 if np.ptp(prediction) == 0.0 else float(spearmanr(prediction, error).statistic)


def share_caught(prediction: np.ndarray, error: np.ndarray) -> float:
    """Of the squared error, in the tenth of the pixels with the highest prediction."""
    chosen = np.argsort(-prediction, kind="stable")[: max(1, round(WORST * len(error)))]
    return float(error[chosen].sum() / max(error.sum(), 1e-12))


def reliability(prediction: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Mean prediction and mean squared error of as many pixels each, by rising prediction; [BINS, 2]."""
    groups = np.array_split(np.argsort(prediction, kind="stable"), BINS)
    return np.array([(prediction[group].mean(), error[group].mean()) for group in groups])


@torch.no_grad()
def arbitrariness(run: Run, frame: Frame, variances: Tensor) -> tuple[float, float]:
    """Multiply both factors of each Gaussian's precision by a random number, which the conditional mean does not see.

    Returns the largest change of a picture's value, and the rank correlation of the variances before and after.
    """
    hyper = run.avatar.hyper
    before, kept = picture_of(run, frame), hyper.heads()
    generator = torch.Generator().manual_seed(0)
    hyper.set_heads({name: rescaled(head, generator) for name, head in kept.items()})
    after, other = picture_of(run, frame), variance_of(run)
    hyper.set_heads(kept)
    return float((after - before).abs().max()), rank_correlation(other.numpy(), variances.numpy())


def picture_of(run: Run, frame: Frame) -> Tensor:
    gaussians = run.avatar(frame.params, None, frame.camera.R_cam_world)
    return run.avatar.draw(gaussians, frame.camera, run.trained.background).image


def rescaled(head: HyperHead, generator: torch.Generator) -> HyperHead:
    """Other factors L11 and L21 with the same L11^-T L21^T."""
    log_factor = ARBITRARY * torch.randn(len(head.mean), 1, 1, generator=generator)
    diagonal = torch.diag_embed(torch.diagonal(head.lower, dim1=1, dim2=2))
    lower = torch.tril(head.lower, -1) * log_factor.exp() + diagonal + log_factor * torch.eye(head.lower.shape[1])
    return head._replace(lower=lower, cross=head.cross * log_factor.exp())


def page(found: Sequence[Found]) -> list[str]:
    header = ["run", "prediction", "rank correlation with the error", f"error in the worst {WORST:.0%} it names"]
    rows = []
    for f in found:
        rows += [[f.name, name, f"{f.spearman[name]:+.2f}", f"{f.caught[name]:.0%}"] for name in PREDICTORS]
        rows.append([f.name, "the error itself", "+1.00", f"{f.oracle:.0%}"])
    lines = ["# Does the conditional variance predict the error?", "", *table(header, rows), ""]
    lines.append(f"Pixels of the head in unseen frames, means of the frames; a guess names {WORST:.0%}.")
    for f in found:
        change, correlation = f.arbitrary
        lines += [
            "",
            f"{f.name}: the variances of the Gaussians differ by a factor of {10**f.spread:.3g} (one standard deviation).",
            f"Both factors of every head times a random number (e^N(0, {ARBITRARY:g})) change no value of a picture by",
            f"more than {change:.1e}, and leave a rank correlation of {correlation:+.2f} between the variances before and",
            "after.",
        ]
    return lines


def draw(found: Sequence[Found]) -> Figure:
    """A row for each run: truth, render, error, variance and training error of a frame, then the reliability plot."""
    from matplotlib.colors import LogNorm

    titles = ("truth, unseen", "render", "squared error", "conditional variance", "error in training")
    figure = new_figure(16, 3.0 * len(found))
    for f, row in zip(found, figure.subplots(len(found), 6, squeeze=False), strict=True):
        for axes, title, picture in zip(row, titles, f.pictures, strict=False):
            levels = picture[np.isfinite(picture) & (picture > 0)]
            low, high = np.quantile(levels, (0.02, 0.99)) if picture.ndim == 2 and levels.size else (1e-6, 1.0)
            norm = LogNorm(max(low, 1e-12), max(high, 1.0001 * max(low, 1e-12))) if picture.ndim == 2 else None
            shown = axes.imshow(picture, norm=norm, cmap="viridis", interpolation="nearest")
            axes.set(title=title, xticks=[], yticks=[])
            if norm is not None:
                figure.colorbar(shown, ax=axes, shrink=0.7)
        row[0].set_ylabel(f.name)
        for name in PREDICTORS:
            row[5].plot(*f.bins[name].clip(1e-9).T, "o-", ms=3, label=f"{name}, {f.spearman[name]:+.2f}")
        limits = np.array([f.bins[name].clip(1e-9) for name in PREDICTORS])
        row[5].plot([limits.min(), limits.max()], [limits.min(), limits.max()], "k--", lw=0.8, label="reliable")
        row[5].set(xscale="log", yscale="log", xlabel="predicted squared error", ylabel="mean squared error")
        row[5].grid(alpha=0.3)
        row[5].legend(fontsize=7)
    return figure


if __name__ == "__main__":
    run(main)
