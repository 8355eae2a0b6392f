from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import pytest
from small_runs import train_small
from tracked_folder import write_tracked_folder

from avatar.bench import Request, quality
from avatar.bench.clock import Time
from avatar.bench.quality import Curve, Point, measure, pareto, run, table
from avatar.bench.train import Learner
from avatar.errors import UserError
from avatar.evaluation.evaluate import evaluate
from avatar.losses.lpips import save_lpips
from avatar.losses.lpips_network import Lpips
from avatar.pipeline.open_inputs import open_run

pytestmark = pytest.mark.slow

ANY = Time(1.0, 1.0, 1)


def curve(name: str, *points: tuple[float, float]) -> Curve:
    made = [Point(step, minutes, psnr, 0.9, 0.05) for step, (minutes, psnr) in enumerate(points)]
    return Curve(name, 10, 100, ANY, ANY, 5, made)


def test_the_first_checkpoint_that_is_good_enough_counts() -> None:
    run = curve("a", (1, 20), (2, 24), (3, 23.9), (4, 25))
    assert (run.minutes_to(23.95), run.minutes_to(19), run.minutes_to(25.1)) == (2, 1, None)
    assert run.best.psnr == 25 and curve("b", (1, 26), (2, 25)).best.minutes == 1


def test_the_front_is_what_no_other_run_has_in_less_time() -> None:
    quick, good, slow, worse = curve("q", (1, 20)), curve("g", (3, 25)), curve("s", (9, 25)), curve("w", (2, 19))
    assert pareto([slow, worse, good, quick]) == [quick, good]


def test_runs_of_one_subject_get_a_curve_each(
    tracked_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, overrides in (
        ("faithful", ["experiment=paper", "data.size=null", "trainer.perceptual=dssim"]),
        ("quick", []),
    ):
        train_small(tracked_folder, tmp_path / name, overrides)
    run(Request(tmp_path, quick=True, inputs=(tmp_path / "faithful", tmp_path / "quick")))
    output = capsys.readouterr().out
    curves = json.loads((tmp_path / "bench_quality.json").read_text())["curves"]
    assert [[point["step"] for point in c["points"]] for c in curves] == [[4, 8, 12]] * 2
    for c in curves:
        rate = (c["early"]["median"] + c["late"]["median"]) / 2
        assert c["points"][-1]["minutes"] == pytest.approx(12 * rate / 60_000)
        assert f"{c['points'][-1]['psnr']:.2f}" in output
    assert iio.imread(tmp_path / "bench_quality.png").shape[1] > 500


def test_figures_are_those_of_the_evaluation(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AVATAR_LPIPS", str(tmp_path / "weights"))
    (tmp_path / "weights").mkdir()
    save_lpips(Lpips("squeeze"), tmp_path / "weights" / "lpips_squeeze.safetensors")
    train_small(tracked_folder, tmp_path / "run")
    (found,) = measure([tmp_path / "run"], None, frames=10_000, repeats=1)
    assert "squeeze, not to be compared with figures of vgg" in capsys.readouterr().out
    written = evaluate(open_run(tmp_path / "run"), ["hypergaussians"], say=lambda _: None)
    means = json.loads(written.read_text())["protocols"]["hypergaussians"]["means"]
    assert found.last.psnr == pytest.approx(means["psnr_head"], abs=1e-6)
    assert found.last.ssim == pytest.approx(means["ssim_head"], abs=1e-6)
    assert found.last.lpips == pytest.approx(means["lpips_head"], rel=1e-5)
    assert f" {found.last.lpips:.4f} " in "\n".join(table([found]))


def test_runs_of_two_subjects_are_refused(tracked_folder: Path, tmp_path: Path) -> None:
    other = write_tracked_folder(tmp_path / "other", frames=30, size=48, seed=9)
    train_small(tracked_folder, tmp_path / "a")
    train_small(other, tmp_path / "b")
    with pytest.raises(UserError, match="other data"):
        measure([tmp_path / "a", tmp_path / "b"], None, frames=1, repeats=1, say=lambda _: None)


def test_a_run_is_timed_with_its_own_perceptual_term_and_not_with_this_machines(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights that came after the training are no part of its steps; those that it had have to be there."""
    timed: list[str] = []
    time_steps = quality.time_steps

    def noted(learners: Sequence[Learner], repeats: int) -> list[tuple[Time, Time]]:
        timed.extend(learner.state.objective.perceptual.name for learner in learners)
        return time_steps(learners, repeats)

    monkeypatch.setattr(quality, "time_steps", noted)
    weights = tmp_path / "weights"
    weights.mkdir()
    save_lpips(Lpips("squeeze"), weights / "lpips_squeeze.safetensors")
    train_small(tracked_folder, tmp_path / "without")
    monkeypatch.setenv("AVATAR_LPIPS", str(weights))
    train_small(tracked_folder, tmp_path / "with")
    measure([tmp_path / "without", tmp_path / "with"], None, frames=1, repeats=1, say=lambda _: None)
    assert timed == ["dssim", "lpips-squeeze"]
    monkeypatch.setenv("AVATAR_LPIPS", str(tmp_path / "nothing"))
    with pytest.raises(UserError, match="the run began with LPIPS and cannot go on without it"):
        measure([tmp_path / "with"], None, frames=1, repeats=1, say=lambda _: None)
