"""scripts/paper's figures: what they say is what was measured, and a stopped one goes on."""

from __future__ import annotations

import csv
import json
from argparse import Namespace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import conditioning
import convergence
import cross_reenactment
import numpy as np
import pytest
import slicing
import systems
import torch
import uncertainty
from lively import lively_run
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.errors import UserError
from avatar.losses.metrics import squared_error
from avatar.pipeline.open_inputs import open_run
from avatar.runs.checkpoint import list_checkpoints, load_checkpoint

pytestmark = pytest.mark.slow


def lines(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.open()))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("figures") / "someone"
    write_tracked_folder(made, frames=12, size=32)
    return made


def words_of(folder: Path, out: Path) -> list[str]:
    head = ["--head", str(folder / "head_model"), "--frame-offset", "1", "--out", str(out)]
    return [str(folder), *head, *SMALL, "data.size=32", "trainer.perceptual=dssim"]


def test_the_mean_moves_and_the_deviation_stays(tmp_path: Path) -> None:
    assert slicing.main(["--out", str(tmp_path)]) == 0
    found = lines(tmp_path / "slicing.csv")
    assert len(found) == 6
    for name, values in slicing.EXAMPLES.items():
        own = [line for line in found if line["example"] == name]
        assert len({line["mean"] for line in own}) == 3 and len({line["deviation"] for line in own}) == 1
        # Along a slice of the joint density, by numerical integration.
        distribution, grid = slicing.joint(slicing.head_of(*values)), torch.linspace(-9, 9, 4001, dtype=torch.float64)
        for line in own:
            latent = torch.full_like(grid, float(line["latent"]))
            weight = distribution.log_prob(torch.stack((grid, latent), -1)).exp()
            weight = weight / weight.sum()
            mean = float((weight * grid).sum())
            assert float(line["mean"]) == pytest.approx(mean, abs=1e-5)
            spread = float((weight * (grid - mean).square()).sum().sqrt())
            assert float(line["deviation"]) == pytest.approx(spread, rel=1e-5)


@pytest.mark.slow
def test_conditioning_is_measured_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--out", str(tmp_path), "--sizes", "2", "--gaussians", "64", "--repeats", "1"]
    assert conditioning.main(words) == 0
    found = {line["way"]: line for line in lines(tmp_path / "conditioning.csv")}
    assert list(found) == [conditioning.TRICK, conditioning.FUSED, conditioning.TEXTBOOK]
    for line in found.values():
        assert float(line["nanoseconds"]) > 0 and line["measured_on"] == "64"
        parameters = 4 * (2 + 3 * 5 + 4 * 6 + 3 * 5)  # bytes at least: latents, means and factors of a head of three
        assert not conditioning.RESET.exists() or float(line["bytes"]) > parameters / 2
    monkeypatch.setattr(conditioning, "measure", None)
    assert conditioning.main(words) == 0 and lines(tmp_path / "conditioning.csv") == list(found.values())


HOLDS = """
import torch
from conditioning import Method, covariance_leaves, one_pass, peak_bytes

def holds(megabytes):
    def offsets(leaves):
        torch.zeros(megabytes * 2**18).add_(1)
        return leaves["latents"] * 2
    return Method(offsets, covariance_leaves)

leaves = {"latents": torch.zeros(4, 4, requires_grad=True)}
one_pass(holds(1), leaves)  # what a library makes once
freed = [torch.ones(2**13) for _ in range(4000)]  # too small to be the system's: the heap keeps them
kept = freed.pop()
del freed
print(*(peak_bytes(holds(megabytes), leaves) for megabytes in (40, 80)))
"""


@pytest.mark.slow
@pytest.mark.skipif(not conditioning.RESET.exists(), reason="the high-water mark is Linux's")
def test_memory_is_that_of_the_pass() -> None:
    """A way that holds forty more megabytes, for a moment, is seen, whatever was freed before."""
    less, more = map(int, conditioning.in_a_process_that_frees(HOLDS).split())
    assert 30 * 2**20 < less < 60 * 2**20 and 30 * 2**20 < more - less < 50 * 2**20


def test_predictions_of_the_error() -> None:
    error = np.arange(1.0, 101.0)
    assert uncertainty.rank_correlation(error**2, error) == pytest.approx(1.0)
    assert uncertainty.rank_correlation(-error, error) == pytest.approx(-1.0)
    assert uncertainty.rank_correlation(np.ones(100), error) == 0.0
    assert uncertainty.share_caught(error, error) == pytest.approx(sum(range(91, 101)) / 5050)
    assert uncertainty.share_caught(-error, error) == pytest.approx(sum(range(1, 11)) / 5050)
    bins = uncertainty.reliability(-error, error)
    assert bins.shape == (uncertainty.BINS, 2)
    assert bins[0].tolist() == [-98.0, 98.0] and bins[-1].tolist() == [-3.0, 3.0]


def test_maps_are_blended_as_colours_are_and_the_variance_is_arbitrary(folder: Path, tmp_path: Path) -> None:
    run = open_run(lively_run(folder, tmp_path / "run", "data.size=32"), folder / "head_model")
    frame = uncertainty.training_frames(run, 1)[0]
    # What is the same for all Gaussians is the same wherever they are seen.
    level = torch.full((len(run.avatar), 1), 3.5)
    values = torch.cat((level, torch.arange(len(run.avatar))[:, None] + 1.0), dim=1)
    drawn = uncertainty.predict(run, frame, values)
    assert bool(drawn.counts.any())
    torch.testing.assert_close(drawn.maps["variance"][drawn.counts], torch.tensor(3.5).expand(int(drawn.counts.sum())))
    torch.testing.assert_close(drawn.error, squared_error(drawn.render, drawn.truth).float())
    assert float(drawn.maps["training"][drawn.counts].std()) > 0

    # A Gaussian's mean error by definition: the pixels' weights are what a picture changes by when it alone is white.
    errors = uncertainty.gaussian_errors(run, [frame])
    gaussians, number = run.trained.gaussians(frame.params, frame.camera), int(errors.argmax())
    sh = torch.full((len(run.avatar), 1, 3), -0.5 / uncertainty.C0)
    sh[number] *= -1
    weight = run.avatar.draw(gaussians._replace(sh=sh), frame.camera, torch.zeros(3)).image[..., 0] * frame.head_mask
    assert float(errors[number]) == pytest.approx(float((weight * drawn.error).sum() / weight.sum()), rel=1e-3)

    variances = uncertainty.variance_of(run)
    change, correlation = uncertainty.arbitrariness(run, frame, variances)
    assert change < 1e-4 and correlation < 0.9
    assert torch.equal(uncertainty.variance_of(run), variances)  # the heads are as they were


@pytest.mark.slow
def test_uncertainty_and_cross_reenactment_leave_what_they_say(folder: Path, tmp_path: Path) -> None:
    words = [*words_of(folder, tmp_path), "--side-by-side"]
    assert uncertainty.main([*words, "--frames", "2"]) == 0
    found = lines(tmp_path / "uncertainty.csv")
    assert len(found) == len(uncertainty.PREDICTORS) * uncertainty.BINS
    assert {line["run"] for line in found} == {"someone, seed 0"}
    assert "| someone, seed 0 | the error itself | +1.00 |" in (tmp_path / "uncertainty.md").read_text()

    assert cross_reenactment.main([*words, "--frames", "2", "--systems", "HyperGaussians n=8"]) == 0
    shown = lines(tmp_path / "cross_reenactment.csv")
    assert [(line["driver"], line["avatar"]) for line in shown] == [("someone", "someone, HyperGaussians n=8")] * 2
    assert len(list((tmp_path / "jobs").iterdir())) == 1  # trained once for both
    for name in ("uncertainty", "cross_reenactment"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit, match="there is no system 'NDGS'; there are FlashAvatar"):
        cross_reenactment.main([*words, "--systems", "NDGS"])


def test_drivers_of_one_name_are_all_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job, trained = (
        Namespace(subject="anna", variant="ours", seed=0),
        Namespace(config=Namespace(data=Namespace(size=8))),
    )
    made: dict[str, Any] = {
        "train": (0, Namespace(jobs=[job])),
        "is_measured": True,
        "run_of": tmp_path,
        "open_trained": trained,
    }

    def driven(trained: Any, name: str, driver: Any, chosen: list[int]) -> cross_reenactment.Driven:
        pictures = [np.zeros((8, 8, 3), np.uint8)] * len(chosen)
        return cross_reenactment.Driven(driver.name, name, ["0", "1"], np.zeros(2), chosen, pictures)

    made["open_driver"] = driver = MagicMock()
    driver.name, driver.__len__.return_value = "ben", 2
    driver.params = lambda i: Namespace(expression=torch.full((2,), float(i)))
    driver.frame = lambda *_: Namespace(image=torch.zeros(8, 8, 3))
    for name, value in made.items():
        monkeypatch.setattr(cross_reenactment, name, lambda *_, value=value: value)
    monkeypatch.setattr(cross_reenactment, "drive", driven)
    words = ["anna", "--out", str(tmp_path), "--frames", "2", "--drivers", "old/ben", "new/ben"]
    assert cross_reenactment.main(words) == 0
    assert [line["driver"] for line in lines(tmp_path / "cross_reenactment.csv")] == ["ben"] * 2 + ["new/ben"] * 2


def test_frames_of_a_driver_differ() -> None:
    expressions = torch.tensor([[0.0, 0.0], [0.1, 0.3], [5.0, 0.0], [4.9, 0.0], [0.0, 2.0]])
    assert cross_reenactment.farthest(expressions, 3) == [0, 2, 4]
    assert cross_reenactment.farthest(expressions, 9) == [0, 1, 2, 3, 4]


def test_convergence_goes_on_from_its_last_mark(folder: Path, tmp_path: Path) -> None:
    words = [*words_of(folder, tmp_path), "trainer.iterations=400", "--frames", "2"]
    assert convergence.main([*words, "--seconds", "0.1"]) == 0
    place = tmp_path / "convergence" / "someone"
    before = {path: load_checkpoint(list_checkpoints(path)[-1]) for path in place.iterdir()}
    assert {path.name for path in before} == {"FlashAvatar", "HyperGaussians_n_8"}
    assert convergence.main([*words, "--seconds", "0.1", "0.3"]) == 0
    for path, old in before.items():
        (file,) = list_checkpoints(path)
        new = load_checkpoint(file)
        assert new.meta["points"][:2] == old.meta["points"] and new.step > old.step > 0
        marks = [point["mark"] for point in new.meta["points"]]
        assert marks == [0.0, 0.1, *convergence.marks([0.1, 0.3])[1:]] and marks[-1] == 0.3
        seconds = [point["seconds"] for point in new.meta["points"]]
        assert all(second >= mark for second, mark in zip(seconds, marks, strict=True)) and seconds == sorted(seconds)
    found = lines(tmp_path / "convergence.csv")
    assert {line["system"] for line in found} == set(convergence.SYSTEMS)
    points = [point for path in before for point in load_checkpoint(list_checkpoints(path)[-1]).meta["points"][1:]]
    assert sorted(float(line["psnr"]) for line in found) == pytest.approx(sorted(point["psnr"] for point in points))
    with pytest.raises(UserError, match="another configuration; give another --out"):
        convergence.main([*words, "trainer.dssim_early=0.3", "--seconds", "0.1"])


def test_marks_lie_between_the_pictures() -> None:
    assert convergence.marks([20.0, 5.0]) == [5.0, 7.9, 12.6, 20.0]
    assert json.loads(json.dumps(convergence.marks([5.0]))) == [5.0]


def test_a_folder_may_have_an_equals_sign_in_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "n=8"
    folder.mkdir()
    assert systems.folders_and_overrides([str(folder), "a.b=1", "someone"]) == ([folder, Path("someone")], ["a.b=1"])


def test_runs_of_one_name_are_all_examined() -> None:
    one, other, third = Path("me/run"), Path("you/run"), Path("n=8")
    assert uncertainty.named([one, other, third]) == {"me/run": one, "you/run": other, "n=8": third}


def test_finished_runs_are_examined_without_training(folder: Path, tmp_path: Path) -> None:
    run = lively_run(folder, tmp_path / "n=8", "data.size=32")
    words = [str(run), "--head", str(folder / "head_model"), "--out", str(tmp_path / "out"), "--frames", "1"]
    assert uncertainty.main(words) == 0
    assert {line["run"] for line in lines(tmp_path / "out" / "uncertainty.csv")} == {"n=8"}
    assert not (tmp_path / "out" / "jobs").exists()
