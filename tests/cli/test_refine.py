"""avatar refine, train --refine and what eval says of refined tracking, as a user meets them."""

from __future__ import annotations

import json
import shutil
from argparse import Namespace
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.commands import train
from avatar.data.source import Source
from avatar.pipeline import refine_plan, train_refined
from avatar.pipeline.open_inputs import source_of
from avatar.pose_refinement import refine_subject as refine_module
from avatar.runs.checkpoint import list_checkpoints

pytestmark = pytest.mark.slow

QUICK = [*SMALL, "trainer.iterations=10"]
LEARNED = [*SMALL, "trainer.iterations=200", "trainer.checkpoint_every=50"]  # where heads are; ten steps prefer a place


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With heads tracked some millimetres beside where they are."""
    folder = write_tracked_folder(tmp_path_factory.mktemp("tracked") / "someone", frames=14, size=40)
    rng = np.random.default_rng(0)
    for path in sorted((folder / "checkpoint").glob("*.frame")):
        content = torch.load(path, weights_only=False)
        content["opencv"]["t"] = content["opencv"]["t"] + rng.normal(0, (0.004, 0.004, 0)).astype(np.float32)
        torch.save(content, path)
    return folder


@pytest.fixture(scope="module")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "first"
    avatar("train", folder, "--out", run, "--frame-offset", 1, *LEARNED)
    return run


@pytest.fixture(scope="module")
def refined(run: Path) -> Path:
    output = avatar("refine", run)
    target = run / "refined" / "someone"
    assert "14/14" in output and "frame/s" in output and "overfit" not in output
    assert "training frames:  head-only PSNR" in output and "held-out frames:" in output
    assert f"Subject      {target}" in output and f"avatar train {target}" in output
    return target


def test_a_refined_folder_is_complete(refined: Path) -> None:
    names = {path.name for path in refined.iterdir()}
    assert {
        "tracking.json",
        "tracking.npz",
        "given.npz",
        "refinement.json",
        "refinement.csv",
        "refinement.png",
    } <= names
    assert {"frames", "matte", "head", "mouth", "head_model"} <= names
    assert not [path for path in refined.parent.iterdir() if path.name.startswith(".")]
    raw = json.loads((refined / "refinement.json").read_text())["refinement"]
    assert raw["tracker"] == "metrical-tracker" and raw["rounds"][0]["step"] == 200
    assert raw["rounds"][0]["trained_on"] == list(range(1, 12))


def test_it_is_trained_on_and_measured_by_both_trackings(refined: Path, folder: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    avatar("train", refined, "--out", again, *QUICK)
    output = avatar("eval", again, "--protocol", "hypergaussians", "--protocol", "strict")
    results = json.loads((again / "eval" / "results.json").read_text())
    entry = results["protocols"]["strict"]
    lines = output.partition("strict")[2].splitlines()
    for line, title, figures in ((lines[1], "tracked", entry["tracked"]), (lines[2], "refined, fitted", entry)):
        assert line.split(title)[1].split()[0] == f"{figures['means']['psnr']:.2f}"
    assert entry["tracked"]["means"]["psnr"] != entry["means"]["psnr"]
    assert len(entry["tracked"]["intervals"]["psnr_head"]) == 2
    tracking = results["tracking"]
    assert (tracking["tracking"], tracking["tracker"]) == ("refined", "metrical-tracker")
    assert tracking["rounds"][0]["measured_frames_trained_on"] == 0
    assert tracking["rounds"][0]["frames_trained_on"] == 11
    assert "which was trained on 11 frames, none of them measured" in output
    assert "tracked: as metrical-tracker left it" in output
    reenacted = avatar("reenact", again, "--driver", refined, "--out", tmp_path / "x.mp4")
    assert "14 frames written" in reenacted


def test_the_tracked_figures_are_those_of_the_tracker(refined: Path, run: Path, tmp_path: Path) -> None:
    """The avatar that the tracking was refined through, measured on the refined folder: `tracked` is its own evaluation."""
    first = avatar("eval", run, "--protocol", "strict")
    assert "refined" not in first and "tracked: as metrical-tracker left it" in first
    own = json.loads((run / "eval" / "results.json").read_text())
    assert own["tracking"]["tracking"] == "tracked" and "tracked" not in own["protocols"]["strict"]
    again = tmp_path / "again"
    avatar("train", refined, "--out", again, *QUICK)
    for name in ("avatar.safetensors",):
        (again / name).write_bytes((run / name).read_bytes())
    avatar("eval", again, "--protocol", "strict")
    both = json.loads((again / "eval" / "results.json").read_text())["protocols"]["strict"]
    for figure in ("psnr", "psnr_head", "ssim_head", "psnr_mouth"):
        assert both["tracked"]["means"][figure] == pytest.approx(own["protocols"]["strict"]["means"][figure], abs=1e-4)
    # the very avatar that the frames were refined through draws them better than before
    assert both["means"]["psnr"] > both["tracked"]["means"]["psnr"]


def test_frames_that_the_avatar_had_seen_are_called_so(refined: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    avatar("train", refined, "--out", again, *QUICK, "data.test_frames=5")
    output = avatar("eval", again, "--protocol", "strict")
    assert "2 of them measured" in output and "refined, fitted (!)" in output
    results = json.loads((again / "eval" / "results.json").read_text())
    assert results["tracking"]["rounds"][0]["measured_frames_trained_on"] == 2


def test_what_cannot_be_is_a_sentence(run: Path, refined: Path, tmp_path: Path) -> None:
    assert "exists already" in avatar("refine", run, status=1)
    assert "is not a run" in avatar("refine", tmp_path, status=1)
    inside = Path(json.loads((run / "run.json").read_text())["source"]["folder"]) / "new"
    assert "which is an input" in avatar("refine", run, "--out", inside, status=1)
    assert "belongs to the run" in avatar("refine", run, "--out", run / "checkpoints", status=1)


def test_an_interrupted_refinement_goes_on(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def soon():
        count = iter(range(100))
        yield lambda: next(count) >= 2

    target = tmp_path / "refined"
    monkeypatch.setattr(refine_plan, "FIRST_STEPS", 4)  # else no round would train for fewer steps
    with monkeypatch.context() as patch:
        patch.setattr(refine_module, "interruption", soon)
        assert "goes on from there" in avatar("refine", run, "--out", target, status=130) and not target.exists()
    output = avatar("refine", run, "--out", target)
    assert "going on after 3 of 14 frames" in output and "refines through one trained for 5 passes" in output
    assert [path.name for path in tmp_path.iterdir()] == ["refined"]


def test_training_in_rounds(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    monkeypatch.setattr(refine_plan, "FIRST_STEPS", 4)
    output = avatar("train", folder, "--out", run, "--frame-offset", 1, "--refine", 2, *QUICK)
    assert "Round 1 of 2" in output and "Round 2 of 2" in output
    assert output.count("4/4") >= 2 and "10/10" in output  # two shorter trainings, and the run's own
    info = json.loads((run / "run.json").read_text())
    assert info["source"]["folder"] == str((run / "rounds" / "2" / "someone").resolve())
    raw = json.loads((run / "rounds" / "2" / "someone" / "refinement.json").read_text())["refinement"]
    assert [Path(one["run"]).parts[-2:] for one in raw["rounds"]] == [("1", "run"), ("2", "run")]
    assert "refined, fitted" in avatar("eval", run, "--protocol", "strict")
    assert "is complete" in avatar("train", "--resume", "--out", run, "--device", "cpu", "trainer.seed=0")
    assert "holds a run with --refine" in avatar("train", folder, "--out", run, "--refine", 1, *QUICK, status=1)


def test_training_in_rounds_keeps_to_its_time(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    words = ["train", folder, "--out", run, "--frame-offset", 1, *QUICK, "trainer.iterations=1000"]
    assert "--minutes goes with --refine" in avatar(*words, "--minutes", 2, status=1)
    assert "must be a positive number" in avatar(*words, "--refine", 1, "--minutes", 0, status=1)
    output = avatar(*words, "--refine", 1, "--minutes", 0.001, status=1)
    assert "too little for --refine 1 of 14 frames" in output and not (run / "rounds").exists()

    # Tracking and opening take 1 s, the round's training 10 and its refinement 20: of the 58.2 that are planned
    # of 60 seconds 27.2 are left, for steps that took 10 seconds for 10.
    monkeypatch.setattr(refine_plan, "estimated_seconds", lambda *_: 3.8)
    monkeypatch.setattr(refine_plan, "measure_cost", lambda *_: SimpleNamespace(start_seconds=0.0, step_seconds=2.5))
    monkeypatch.setattr(refine_plan, "LEAST_STEPS", 5)
    ticks = iter((0.0, 0.0, 1.0, 1.0, 11.0, 31.0, 57.0))
    for module in (train, train_refined, refine_plan):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
    output = avatar(*words, "--refine", 1, "--minutes", 1)
    assert "allow 10 steps; 10 are taken" in output and "of 1 minutes" in output
    assert "31 s of 1 minutes are gone, and a step takes 1.000 s: 27 steps are taken" in output
    steps = [json.loads((one / "run.json").read_text())["config"]["trainer"]["iterations"] for one in (first(run), run)]
    assert steps == [10, 27] and json.loads((run / "rounds" / "plan.json").read_text())["spent"] == 57.0
    monkeypatch.undo()
    assert "with --minutes 1, not 3" in avatar("train", "--resume", "--out", run, "--minutes", 3, status=1)
    assert "is complete" in avatar(*words, "--refine", 1, "--minutes", 1, "--resume")


def test_the_minutes_include_tracking(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a mistake is found before it."""
    clock, run = [0.0], tmp_path / "run"
    words = ["train", folder, "--out", run, "--frame-offset", 1, *QUICK, "trainer.iterations=1000"]

    def tracked(arguments: Namespace) -> Source:
        clock[0] += 90.0
        return source_of(arguments)

    def measured(*_: object) -> float:
        clock[0] += 20.0  # which preparing the subject comes before
        return 10.0

    for module in (train, train_refined, refine_plan):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(train, "tracked_source", tracked)
    monkeypatch.setattr(refine_plan, "estimated_seconds", measured)
    monkeypatch.setattr(refine_plan, "measure_cost", lambda *_: SimpleNamespace(start_seconds=5.0, step_seconds=0.05))
    assert "must be from 1 to 10" in avatar(*words, "--refine", 99, "--minutes", 5, status=1)
    assert clock == [0.0]
    monkeypatch.setattr(train_refined, "train_round", lambda plan, *_: (0, plan))
    monkeypatch.setattr(train_refined, "continue_or_begin", lambda *_: 0)
    output = avatar(*words, "--refine", 1, "--minutes", 5)
    # 0.97 of 300 seconds less 110, 10 and two starts of 5, by a twentieth of a second a step, less the round's 1,000
    assert "5 minutes, 110 s of them gone" in output and "1.8 of 5 minutes" in output
    assert "allow 2,220 steps; 1,000 are taken" in output
    refused = avatar(*words[:3], tmp_path / "other", *words[4:], "--refine", 1, "--minutes", 2, status=1)
    assert "110 s are gone" in refused and "give at least 3.1" in refused


def first(run: Path) -> Path:
    """The run of the first round."""
    return run / "rounds" / "1" / "run"


def test_what_the_first_folder_was_allowed_later_ones_are(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, devices = list[Source](), list[tuple[str, ...]]()
    monkeypatch.setattr(train_refined, "continue_or_begin", lambda source, *_: opened.append(source) or 0)
    monkeypatch.setattr(train_refined, "open_run", lambda *_: None)
    monkeypatch.setattr(train_refined, "refine_run", lambda *given: devices.append(given[2:]) or 0)
    words = ("--frame-offset", 1, "--fps", 30, "--max-left-out", 0.5, "--ignore-misfit", "--refine", 1)
    avatar("train", folder, "--out", tmp_path / "run", *words, *QUICK)
    given, later = opened
    assert (given.folder, given.frame_offset, given.fps) == (folder, 1, 30.0)
    assert later == Source(
        tmp_path / "run" / "rounds" / "1" / "someone", given.head, max_left_out=0.5, ignore_misfit=True
    )
    avatar("train", "--resume", "--out", tmp_path / "run", "--device", "cpu")
    assert devices == [("auto",), ("cpu",)]


def test_rounds_go_on_where_the_folder_has_moved(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, after, run = tmp_path / "before" / "someone", tmp_path / "after" / "other", tmp_path / "run"
    shutil.copytree(folder, before)

    @contextmanager
    def at_once():
        yield lambda: True

    with monkeypatch.context() as patch:
        patch.setattr(refine_module, "interruption", at_once)
        avatar("train", before, "--out", run, "--frame-offset", 1, "--refine", 1, *QUICK, status=130)
    after.parent.mkdir()
    before.rename(after)
    assert f"is gone: avatar train NEW_PLACE --resume --out {run}" in avatar(
        "train", "--resume", "--out", run, status=1
    )
    output = avatar("train", after, "--resume", "--out", run)
    assert "going on after 1 of 14 frames" in output and "10/10" in output
    assert (run / "rounds" / "1" / "someone" / "tracking.npz").is_file()


def test_rounds_go_on_where_they_stopped(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    words = ["train", folder, "--out", run, "--frame-offset", 1, "--refine", 1, *QUICK]

    @contextmanager
    def at_once():
        yield lambda: True

    with monkeypatch.context() as patch:
        patch.setattr(refine_module, "interruption", at_once)
        assert "Interrupted" in avatar(*words, status=130)
    stage = run / "rounds" / "1"
    stamps = [path.stat().st_mtime_ns for path in list_checkpoints(stage / "run" / "checkpoints")]
    assert stamps and not (run / "run.json").exists()
    assert all("add --resume" in avatar(*each, status=1) for each in (words, [*words[:6], *QUICK]))
    assert "began with --refine 1, not 2" in avatar("train", "--resume", "--out", run, "--refine", 2, status=1)
    changed = avatar("train", "--resume", "--out", run, "trainer.iterations=11", status=1)
    assert "leave the override out" in changed
    assert "began with --frame-offset 1" in avatar("train", "--resume", "--out", run, "--frame-offset", 2, status=1)
    other = write_tracked_folder(tmp_path / "other", frames=4, size=24)
    assert "began on" in avatar("train", other, "--resume", "--out", run, status=1)
    output = avatar("train", "--resume", "--out", run)
    assert "going on after 1 of 14 frames" in output and "10/10" in output
    assert stamps == [path.stat().st_mtime_ns for path in list_checkpoints(stage / "run" / "checkpoints")]


def test_a_plain_run_and_a_damaged_plan(run: Path, folder: Path, tmp_path: Path) -> None:
    assert "began without --refine" in avatar("train", "--resume", "--out", run, "--refine", 1, status=1)
    for number in (0, 11):
        output = avatar("train", folder, "--out", tmp_path / "x", "--refine", number, *QUICK, status=1)
        assert "from 1 to 10" in output and not (tmp_path / "x").exists()
    plan = tmp_path / "y" / "rounds" / "plan.json"
    plan.parent.mkdir(parents=True)
    for text, said in (("{", "cannot be read"), ('{"format": 9}', "another version"), ('{"format": 2}', "damaged")):
        plan.write_text(text)
        assert said in avatar("train", "--resume", "--out", tmp_path / "y", status=1)
