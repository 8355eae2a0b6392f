"""Figures of a refined subject: what was fitted to the measured frames is said, marked, and never comes first."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from disc import TEST, BlobRenderer, make_run, make_subject, read_png, refined

from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.evaluation import evaluate as evaluate_module
from avatar.evaluation import frame_curves as curves_module
from avatar.evaluation.compare import compare_runs
from avatar.evaluation.compare_tables import FORMATS
from avatar.evaluation.evaluate import evaluate
from avatar.evaluation.verify import verify
from avatar.report.page import bins_tables, means_table

SEEN = (0, 1, 2, 8)  # as numbers of the tracking: one of them is measured
PROTOCOLS = ["hypergaussians", "strict"]
Evaluated = tuple[dict[str, Any], str]  # results.json, what was said


def evaluated(path: Path, subject: Subject, **options: Any) -> Evaluated:
    said: list[str] = []
    results = evaluate(make_run(path, subject), PROTOCOLS, say=said.append, **options)
    return json.loads(results.read_text()), "\n".join(said)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Evaluated]:
    """By folder: a refined subject, and the same refined through an avatar that had seen a measured frame."""
    folder = tmp_path_factory.mktemp("runs")
    subject = make_subject(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AVATAR_CACHE", str(folder / "cache"))
        patch.setattr(evaluate_module, "Renderer", BlobRenderer)
        patch.setattr(evaluate_module, "curves", lambda *_: b"drawn")
        return {
            folder / "unseen": evaluated(folder / "unseen", refined(subject), write_frames=True),
            folder / "seen": evaluated(folder / "seen", refined(subject, SEEN)),
        }


@pytest.fixture
def unseen(runs: dict[Path, Evaluated], tmp_path: Path) -> Path:
    """A copy, to be changed."""
    return Path(shutil.copytree(next(iter(runs)), tmp_path / "unseen"))


def test_both_figures_stand_side_by_side_and_the_unfitted_first(runs: dict[Path, Evaluated]) -> None:
    results, said = next(iter(runs.values()))
    for name in PROTOCOLS:
        entry = results["protocols"][name]
        assert entry["driven_by"] == "refined" and list(entry).index("tracked") < list(entry).index("means")
        assert set(entry["tracked"]["means"]) == set(entry["means"]), "jitter too"
        assert entry["tracked"]["means"]["jitter"] is not None
        lines = said.splitlines()
        place = next(number for number, line in enumerate(lines) if line.startswith(name))
        for line, figures in zip(lines[place + 1 : place + 3], (entry["tracked"], entry), strict=True):
            assert f"{figures['means']['psnr']:.2f}" in line
        assert lines[place + 1].split()[0] == "tracked" and lines[place + 2].split()[:2] == ["refined,", "fitted"]
        assert not re.search(r"\d\.\d", lines[place]), "no figure without its tracking"


def test_results_say_that_measured_frames_were_fitted_to_their_pictures(runs: dict[Path, Evaluated]) -> None:
    results, said = next(iter(runs.values()))
    (note,) = [note for note in results["notes"] if "refined" in note]
    assert "fitted to its own picture" in note and "runs/first" in note and "none of them measured" in note
    assert said.count(note) == 1 and "(!)" not in said
    assert "own picture" in results["tracking"]["refined"]


def test_the_tracked_figures_are_those_of_the_subject_before(
    runs: dict[Path, Evaluated], tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluate_module, "curves", lambda *_: b"drawn")
    before, said = evaluated(tmp_path / "before", refined(subject).as_tracked())
    (refined_results, _) = next(iter(runs.values()))
    for name in PROTOCOLS:
        assert refined_results["protocols"][name]["tracked"]["means"] == before["protocols"][name]["means"]
    plain, said = evaluated(tmp_path / "plain", subject)
    assert "refined" not in said and "own picture" in plain["tracking"]["tracked"]
    assert all(entry["driven_by"] == "tracked" and "tracked" not in entry for entry in plain["protocols"].values())


def test_details_worst_frames_curves_and_video_are_of_the_unfitted_tracking(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[str, np.ndarray]] = []
    real = curves_module.line
    monkeypatch.setattr(
        curves_module, "line", lambda rows, name: (drawn.append((name, real(rows, name)[1])), real(rows, name))[1]
    )
    sheets: list[list[dict[str, Any]]] = []
    monkeypatch.setattr(
        evaluate_module, "worst_sheet", lambda run, renderer, protocol, worst: sheets.append(worst) or b"x"
    )
    results, said = evaluated(tmp_path / "run", refined(subject))
    entry = results["protocols"]["hypergaussians"]
    assert sheets == [entry["tracked"]["worst"]] != [entry["worst"]]
    assert f"({entry['tracked']['worst'][0]['psnr']:.2f})" in said
    first = next(values for name, values in drawn if name == "psnr")
    rows = list(csv.DictReader((tmp_path / "run" / "eval" / "hypergaussians" / "tracked.csv").open()))
    assert first == pytest.approx([float(row["psnr"]) for row in rows], abs=1e-6)


def test_worst_frames_are_drawn_by_the_unfitted_tracking(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluate_module, "curves", lambda *_: b"drawn")
    run = make_run(tmp_path / "run", refined(subject))
    evaluate(run, ["strict"], say=lambda _: None)
    worst = [0.9 * index / 9 for index in TEST]
    assert sorted(run.avatar.seen[-3:]) == pytest.approx(worst)


def test_a_run_whose_measured_frames_were_trained_on_is_marked_in_every_table(runs: dict[Path, Evaluated]) -> None:
    results, said = list(runs.values())[1]
    (warning,) = [note for note in results["notes"] if note.startswith("(!)")]
    assert "trained on" in warning and warning in said
    assert results["tracking"]["rounds"][0]["measured_frames_trained_on"] == 1
    lines = [line for line in said.splitlines() if line.split()[:1] in (["tracked"], ["refined,"])]
    assert len(lines) >= 8 and all("(!)" in line for line in lines)

    comparison = compare_runs(list(runs))
    tables = {name: table(comparison) for name, (_, table) in FORMATS.items()}
    for name in ("text", "markdown", "latex"):
        assert "seen (!)" in tables[name] and "unseen (!)" not in tables[name] and warning in tables[name]
    rows = list(csv.DictReader(io.StringIO(tables["csv"])))
    assert {row["run"]: row["marked"] for row in rows} == {"unseen": "", "seen": "(!)"}

    page = means_table(results["protocols"], " (!)") + "".join(bins_tables(results["protocols"], " (!)"))
    names = re.findall(r"(?:strict|hypergaussians), (?:tracked|refined, fitted)[^<,]*", page)
    assert names[:2] == ["hypergaussians, tracked (!)", "hypergaussians, refined, fitted (!)"]
    assert all("(!)" in name for name in names)


def test_comparisons_pair_each_tracking_by_itself(runs: dict[Path, Evaluated]) -> None:
    results, _ = next(iter(runs.values()))
    comparison = compare_runs(list(runs))
    assert [(each.protocol, each.drive) for each in comparison.protocols] == [
        (name, drive) for name in PROTOCOLS for drive in ("tracked", "refined")
    ]
    for each in comparison.protocols:
        entry = results["protocols"][each.protocol]
        figures = entry["tracked"] if each.drive == "tracked" else entry
        assert each.rows["psnr"][0].mean == pytest.approx(figures["means"]["psnr"], abs=1e-6)
    for _, table in list(FORMATS.values())[:3]:
        shown = table(comparison)
        assert shown.index("(tracked)") < shown.index("(refined, fitted)") and "no figures of unseen frames" in shown
        heads = [line for line in shown.splitlines() if "refined, fitted" in line]
        assert len(heads) >= 3 * len(PROTOCOLS) - 2, "a table that is cut out names its tracking"


def test_the_perceptual_term_is_in_results_and_comparison(runs: dict[Path, Evaluated], unseen: Path) -> None:
    first = next(iter(runs))
    results = json.loads((unseen / "eval" / "results.json").read_text())
    assert results["perceptual"] == "dssim"
    assert "Perceptual term in training: dssim" in FORMATS["text"][1](compare_runs([first, first]))
    (unseen / "eval" / "results.json").write_text(json.dumps({**results, "perceptual": "lpips-vgg"}))
    comparison = compare_runs([first, unseen])
    for name in ("text", "markdown", "latex"):
        shown = FORMATS[name][1](comparison)
        assert "differ" in shown and f"{first} dssim" in shown and f"{unseen} lpips-vgg" in shown
    assert "lpips-vgg" in FORMATS["csv"][1](comparison).splitlines()[2].split(",")


def test_figures_of_another_perceptual_term_do_not_stand_beside(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluate_module, "curves", lambda *_: b"drawn")
    run = make_run(tmp_path / "run", subject)
    evaluate(run, ["strict"], say=lambda _: None)
    run.trained.perceptual = "lpips-vgg"
    results = json.loads(evaluate(run, ["hypergaussians"], say=lambda _: None).read_text())
    assert list(results["protocols"]) == ["hypergaussians"]


def test_verify_recomputes_the_tracked_figures_too(unseen: Path) -> None:
    path, said = unseen / "eval" / "results.json", []
    verify(path, say=said.append)
    assert [line.partition(":")[0] for line in said] == [
        f"{name}, {drive}" for name in PROTOCOLS for drive in ("tracked", "refined")
    ]
    entries = json.loads(path.read_text())["protocols"].values()
    assert all(part["verified"]["frames"] == 3 for entry in entries for part in (entry, entry["tracked"]))

    picture = unseen / "eval" / "strict" / "tracked_renders" / "00008.png"
    image = read_png(picture)
    image[36, 36, 1] ^= 64
    assert cv2.imwrite(str(picture), image)
    with pytest.raises(UserError, match=r"psnr of frame 00009 is .*strict/tracked\.csv"):
        verify(path, ["strict"], lambda _: None)


def test_a_tracked_mean_that_was_changed_is_found(unseen: Path) -> None:
    path = unseen / "eval" / "results.json"
    results = json.loads(path.read_text())
    results["protocols"]["strict"]["tracked"]["means"]["jitter"] += 3e-6
    path.write_text(json.dumps(results))
    with pytest.raises(UserError, match="jitter of the mean"):
        verify(path, ["strict"], lambda _: None)
