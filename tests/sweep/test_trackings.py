"""Tables of a sweep over subjects of which some were refined, on results that are written here."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar.errors import UserError
from avatar.evaluation.compare_tables import FORMATS
from avatar.sweep.results import fold_results, interval
from avatar.sweep.spec import Job, Resources, Spec

PLAIN, REFINED = "plain", "refined"


def write_job(folder: Path, subject: str, variant: str, psnr: float, perceptual: str = "dssim", seen: int = 0) -> Job:
    job = Job(f"{subject}-{variant}", subject, variant, 0, {"folder": subject}, (), ("strict",))
    measured = {"choices": {}, "lpips": {"weights_sha256": None}, "bootstrap": {"block_frames": 1}}
    entry: dict[str, Any] = {"driven_by": "tracked", "means": {"psnr": psnr}, "frames_sha256": ""}
    tracking: dict[str, Any] = {"tracker": "insta", "rounds": []}
    if subject == REFINED:
        entry = {**entry, "driven_by": "refined", "means": {"psnr": psnr + 2}, "tracked": entry}
        tracking |= {"refined": "fitted to its own picture", "rounds": [{"measured_frames_trained_on": seen}]}
    results = {"format": 3, "data_hash": "a", "head_fingerprint": "b", "image_size": [64, 64]}
    results |= {"perceptual": perceptual, "tracking": tracking, "protocols": {"strict": entry | measured}}
    path = folder / "jobs" / job.name / "run" / "eval" / "results.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(results))
    return job


def changed(folder: Path, job: Job, entry: dict[str, Any] | None = None, **results: Any) -> None:
    """Change what a job has measured: keys of its results, or of its protocol's entry."""
    path = folder / "jobs" / job.name / "run" / "eval" / "results.json"
    found = json.loads(path.read_text()) | results
    found["protocols"]["strict"] |= entry or {}
    path.write_text(json.dumps(found))


def test_fitted_figures_are_a_table_of_their_own_below_the_others(tmp_path: Path) -> None:
    jobs = [
        write_job(tmp_path, subject, variant, p)
        for subject in (PLAIN, REFINED)
        for variant, p in (("a", 20), ("b", 21))
    ]
    comparison = fold_results(tmp_path, Spec(tuple(jobs), Resources(), 0))
    tracked, refined = comparison.protocols
    assert (tracked.drive, tracked.count, refined.drive, refined.count) == ("tracked", 2, "refined", 1)
    assert [cell.mean for cell in tracked.rows["psnr"]] == [20, 21], "nothing fitted is mixed in"
    assert [cell.mean for cell in refined.rows["psnr"]] == pytest.approx([22, 23])
    assert comparison.marked == [False, False] and comparison.perceptual == ["dssim", "dssim"]
    for name in ("text", "markdown", "latex"):
        shown = FORMATS[name][1](comparison)
        assert shown.index("strict (tracked)") < shown.index("strict (refined, fitted)")
        assert "no figures of unseen frames" in shown and "(!)" not in shown


def test_a_variant_with_a_job_that_saw_measured_frames_is_marked_and_mixed_terms_are_said(tmp_path: Path) -> None:
    jobs = [write_job(tmp_path, PLAIN, "a", 20), write_job(tmp_path, REFINED, "a", 20, "lpips-vgg")]
    jobs += [write_job(tmp_path, PLAIN, "b", 21), write_job(tmp_path, REFINED, "b", 21, seen=3)]
    comparison = fold_results(tmp_path, Spec(tuple(jobs), Resources(), 0))
    assert comparison.marked == [False, True] and comparison.perceptual == ["dssim and lpips-vgg", "dssim"]
    for name in ("text", "markdown", "latex"):
        shown = FORMATS[name][1](comparison)
        assert "b (!)" in shown and "a (!)" not in shown and "(!): " in shown
        assert "a dssim and lpips-vgg, b dssim" in shown


def test_intervals_know_how_few_trainings_there_are() -> None:
    assert interval(np.array([1.0])) is None
    assert interval(np.array([1.0, 3.0])) == pytest.approx(
        (2 - 12.706, 2 + 12.706), abs=1e-3
    )  # of tables of Student's t
    assert interval(np.array([1.0, 3.0, 1.0, 3.0])) == pytest.approx((2 - 1.8374, 2 + 1.8374), abs=1e-3)


def test_each_kind_of_refinement_is_explained(tmp_path: Path) -> None:
    jobs = [write_job(tmp_path, REFINED, variant, 20) for variant in "ab"]
    tracking = {
        "tracker": "VHAP",
        "refined": "fitted to the pictures of cameras",
        "rounds": [{"measured_frames_trained_on": 0}],
    }
    changed(tmp_path, jobs[1], tracking=tracking)
    said = "\n".join(fold_results(tmp_path, Spec(tuple(jobs), Resources(), 0)).tracking)
    assert "fitted to its own picture;" in said and "fitted to the pictures of cameras;" in said


def test_the_first_variant_of_the_file_is_compared_with_where_its_first_job_has_no_results(tmp_path: Path) -> None:
    jobs = [write_job(tmp_path, "one", "b", 21)]
    jobs += [write_job(tmp_path, "two", variant, psnr) for variant, psnr in (("a", 20), ("b", 21))]
    failed = Job("one-a", "one", "a", 0, {"folder": "one"}, (), ("strict",))
    comparison = fold_results(tmp_path, Spec((failed, *jobs), Resources(), 0))
    first, second = comparison.protocols[0].rows["psnr"]
    assert comparison.labels == ["a", "b"] and (first.mean, second.difference) == (20, 1)


def test_lpips_of_different_networks_is_left_out_with_a_note(tmp_path: Path) -> None:
    jobs = [write_job(tmp_path, PLAIN, variant, 20) for variant in ("a", "b")]
    for job, network in zip(jobs, ("1" * 64, "2" * 64), strict=True):
        means = {"psnr": 20, "lpips": 0.1, "lpips_head": 0.1}
        changed(tmp_path, job, {"means": means, "lpips": {"weights_sha256": network}})
    comparison = fold_results(tmp_path, Spec(tuple(jobs), Resources(), 0))
    assert list(comparison.protocols[0].rows) == ["psnr"]
    assert comparison.notes == ["strict: LPIPS is left out, because the jobs were measured with different networks"]


@pytest.mark.parametrize(
    ("entry", "results", "what"),
    [
        ({}, {"image_size": [128, 128]}, "image size"),
        ({}, {"data_hash": "c"}, "data"),
        ({}, {"head_fingerprint": "c"}, "head model"),
        ({"frames": ["00002"]}, {}, "frames"),
    ],
)
def test_variants_that_were_measured_on_something_else_are_not_compared(
    tmp_path: Path, entry: dict[str, Any], results: dict[str, Any], what: str
) -> None:
    jobs = [write_job(tmp_path, name, variant, p) for name in ("one", "two") for variant, p in (("a", 20), ("b", 21))]
    for job in jobs:
        changed(tmp_path, job, {"frames": ["00001", "00002"]})
    changed(tmp_path, jobs[1], entry, **results)
    spec = Spec(tuple(jobs), Resources(), 0)
    comparison = fold_results(tmp_path, spec)
    assert comparison.protocols[0].count == 1 and comparison.protocols[0].unit == "trainings each (1 subjects, 1 seeds)"
    note = f"subjects and seeds are left out, because their variants were measured on different {what}"
    assert comparison.notes == [f"strict: 1 of 2 {note}"]
    changed(tmp_path, jobs[3], entry, **results)
    comparison = fold_results(tmp_path, spec)
    assert comparison.labels == ["a"] and comparison.protocols[0].rows["psnr"] == [(20.0, None, None)]
    assert comparison.notes == [f"b is left out: it was measured on different {what} than a"]


def test_a_protocol_that_was_edited_in_between_is_left_out(tmp_path: Path) -> None:
    jobs = [write_job(tmp_path, name, variant, 20) for name in ("one", "two") for variant in "ab"]
    for job, levels in zip(jobs, ("round", "round", "truncate", "truncate"), strict=True):
        changed(tmp_path, job, {"choices": {"levels": levels}})
    with pytest.raises(UserError, match="strict differs between the runs in levels"):
        fold_results(tmp_path, Spec(tuple(jobs), Resources(), 0))


def test_a_figure_that_some_jobs_lack_is_left_out_with_a_note(tmp_path: Path) -> None:
    jobs = [write_job(tmp_path, name, variant, 20) for name in ("one", "two") for variant in "ab"]
    for job in jobs:
        changed(tmp_path, job, {"means": {"psnr": 20, "psnr_eyes": None if job.subject == "two" else 20}})
    comparison = fold_results(tmp_path, Spec(tuple(jobs), Resources(), 0))
    assert list(comparison.protocols[0].rows) == ["psnr"]
    assert comparison.notes == ["strict: left out, because some jobs have no such figure: psnr_eyes"]


def test_a_line_break_in_a_name_does_not_end_the_comment_of_latex(tmp_path: Path) -> None:
    jobs = [write_job(tmp_path, PLAIN, variant, 20) for variant in ("a\nb", "c")]
    comparison = fold_results(tmp_path, Spec(tuple(jobs), Resources(), 0))
    assert comparison.labels == ["a b", "c"]
