"""A sweep's figures as the tables of `avatar compare`: means over subjects and seeds, differences to the first variant."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from avatar.errors import UserError
from avatar.evaluation.bootstrap import LEVEL, Interval
from avatar.evaluation.compare import (
    SAME,
    Cell,
    Comparison,
    Evaluation,
    ProtocolComparison,
    common_protocols,
    read_evaluation,
)
from avatar.evaluation.tracking_source import Drive, is_marked, legend
from avatar.sweep.spec import Job, Spec


def fold_results(folder: Path, spec: Spec) -> Comparison:
    """Means of each variant, and paired differences, over the (subject, seed) pairs that all variants have.

    Intervals are Student's t over those pairs, each one training: unlike those of `avatar compare` they know of the
    training's seed. Raises UserError when no pair is evaluated for all variants.
    """
    notes: list[str] = []
    evaluations = read_evaluations(folder, spec.jobs, notes)
    evaluated = {job.variant for job, _ in evaluations}
    variants = [variant for variant in dict.fromkeys(job.variant for job in spec.jobs) if variant in evaluated]
    variants = measured_like_the_first(evaluations, variants, notes)
    evaluations = [one for one in evaluations if one[0].variant in variants]
    protocols = list(dict.fromkeys(name for _, each in evaluations for name in each.results["protocols"]))
    comparisons = []
    drives: tuple[Drive, ...] = ("tracked", "refined")
    for protocol in protocols:
        for drive in drives:
            compared = compare_variants(evaluations, variants, protocol, drive, notes)
            if compared is not None:
                comparisons.append(compared)
    if not comparisons:
        why = "".join(f"; {note}" for note in dict.fromkeys(notes))
        raise UserError(f"no subject and seed in {folder} is measured for all {len(variants)} variants yet{why}")
    by_variant = {
        variant: [each.results for job, each in evaluations if job.variant == variant] for variant in variants
    }
    return Comparison(
        [" ".join(variant.split()) for variant in variants],  # a line break would end LaTeX's comment
        [any(is_marked(results["tracking"]) for results in own) for own in by_variant.values()],
        [" and ".join(sorted({results["perceptual"] for results in own})) for own in by_variant.values()],
        comparisons,
        legend([each.results["tracking"] for _, each in evaluations]),
        list(dict.fromkeys(notes)),
    )


def read_evaluations(folder: Path, jobs: Sequence[Job], notes: list[str]) -> list[tuple[Job, Evaluation]]:
    """Of the jobs that have results; what is missing goes into `notes`."""
    runs = {job.name: folder / "jobs" / job.name / "run" for job in jobs}
    done = [job for job in jobs if (runs[job.name] / "eval" / "results.json").is_file()]
    if len(done) < len(jobs):
        notes.append(f"{len(jobs) - len(done)} of {len(jobs)} jobs have no results, and do not count")
    absent = {job.variant for job in jobs} - {job.variant for job in done}
    notes.extend(f"{variant} is left out: none of its jobs has results" for variant in sorted(absent))
    return [(job, read_evaluation(job.name, runs[job.name])) for job in done]


def compare_variants(
    evaluations: Sequence[tuple[Job, Evaluation]],
    variants: Sequence[str],
    protocol: str,
    drive: Drive,
    notes: list[str],
) -> ProtocolComparison | None:
    """None where no (subject, seed) pair is there for all variants, driven so. What is left out goes into `notes`."""
    measured = [one for one in evaluations if protocol in one[1].results["protocols"]]
    if not common_protocols([evaluation for _, evaluation in measured], [protocol], notes):
        return None
    found: dict[str, dict[tuple[str, int], Evaluation]] = {variant: {} for variant in variants}
    for job, evaluation in measured:
        if drive in evaluation.parts(protocol):
            found[job.variant][job.subject, job.seed] = evaluation
    pairs = sorted(set.intersection(*map(set, found.values()))) if found else []
    pairs = comparable({pair: [found[variant][pair] for variant in variants] for pair in pairs}, protocol, notes)
    if not pairs:
        return None
    means: dict[str, dict[tuple[str, int], Mapping[str, float | None]]] = {
        variant: {pair: found[variant][pair].parts(protocol)[drive].figures["means"] for pair in pairs}
        for variant in variants
    }
    entries = [found[variant][pair].results["protocols"][protocol] for variant in variants for pair in pairs]
    figures = [
        name for name in means[variants[0]][pairs[0]] if all(name in means[v][p] for v in variants for p in pairs)
    ]
    if len({entry["lpips"]["weights_sha256"] for entry in entries}) > 1:
        figures = [name for name in figures if not name.startswith("lpips")]
        notes.append(f"{protocol}: LPIPS is left out, because the jobs were measured with different networks")
    rows: dict[str, list[Cell]] = {}
    lacking = []
    for figure in figures:
        values = [np.array([_number(means[variant][pair][figure]) for pair in pairs]) for variant in variants]
        if not np.isfinite(values).all():
            lacking.append(figure)
            continue
        first = values[0]
        rows[figure] = [Cell(float(first.mean()), None, None)] + [
            Cell(float(own.mean()), float((own - first).mean()), interval(own - first)) for own in values[1:]
        ]
    if lacking:
        notes.append(f"{protocol}: left out, because some jobs have no such figure: {', '.join(lacking)}")
    subjects, seeds = len({subject for subject, _ in pairs}), len({seed for _, seed in pairs})
    unit = f"trainings each ({subjects} subjects, {seeds} seeds)"
    return ProtocolComparison(protocol, drive, len(pairs), unit, "Student's t over trainings", rows)


def measured_like_the_first(
    evaluations: Sequence[tuple[Job, Evaluation]], variants: Sequence[str], notes: list[str]
) -> list[str]:
    """The variants without those that were measured on something else than the first one, whatever subject and seed."""
    first = {(job.subject, job.seed): own for job, own in evaluations if job.variant == variants[0]}
    kept = []
    for variant in variants:
        same = [
            differing((first[job.subject, job.seed], own), protocol)
            for job, own in evaluations
            if job.variant == variant and (job.subject, job.seed) in first
            for protocol in own.results["protocols"].keys() & first[job.subject, job.seed].results["protocols"].keys()
        ]
        if same and all(same):
            what = ", ".join(sorted(set().union(*same)))
            notes.append(f"{variant} is left out: it was measured on different {what} than {variants[0]}")
        else:
            kept.append(variant)
    return kept


def comparable(
    pairs: Mapping[tuple[str, int], Sequence[Evaluation]], protocol: str, notes: list[str]
) -> list[tuple[str, int]]:
    """Those pairs whose variants were measured on the same."""
    odd = {pair: what for pair, evaluations in pairs.items() if (what := differing(evaluations, protocol))}
    if odd:
        notes.append(
            f"{protocol}: {len(odd)} of {len(pairs)} subjects and seeds are left out, because their variants were "
            f"measured on different {', '.join(sorted(set().union(*odd.values())))}"
        )
    return [pair for pair in pairs if pair not in odd]


def differing(evaluations: Sequence[Evaluation], protocol: str) -> set[str]:
    """Of data, head model, image size and frames those in which the evaluations differ: figures of others say nothing about
    which variant is better."""
    first, *others = (
        {"frames": each.results["protocols"][protocol].get("frames"), **{what: each.results[key] for key, what in SAME}}
        for each in evaluations
    )
    return {what for what in first for other in others if other[what] != first[what]}


def interval(differences: np.ndarray) -> Interval | None:
    """Student's interval of the mean; None for a single value."""
    count = len(differences)
    if count < 2:
        return None
    mean, spread = float(differences.mean()), float(differences.std(ddof=1)) / math.sqrt(count)
    reach = float(stats.t.ppf((1 + LEVEL) / 2, count - 1)) * spread
    return mean - reach, mean + reach


def _number(value: float | None) -> float:
    return math.nan if value is None else value
