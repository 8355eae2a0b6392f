"""The disturbance, the figures and the report of the benchmark of refinement."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from drawn_clip import drawn_clip, patterned_avatar, true_tracks
from tracked_folder import write_tracked_folder

from avatar.bench import refine as bench
from avatar.bench.perturb_tracking import COEFFICIENT_SHARE, SHIFT_MM, TURN_DEGREES, perturbed, tracking_noise
from avatar.bench.refine import Figures, Row, recovered, report, vertex_error
from avatar.cli import main
from avatar.data.recording import Recording
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement.tracking_values import EXPRESSION, EYELIDS, NECK, values_of
from avatar.pose_refinement.write_results import movements


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    return patterned_avatar(tmp_path_factory.mktemp("head"))


@pytest.fixture(scope="module")
def recording(avatar: Avatar) -> Recording:
    few = drawn_clip(avatar, frames=4, train=3).recording
    return replace(few, tracks=true_tracks(4000), names=tuple(map(str, range(4000))))


def test_the_disturbance_is_as_large_as_it_says(avatar: Avatar, recording: Recording) -> None:
    bent = perturbed(recording, avatar.head, seed=1)
    centre = avatar.head.neutral_vertices().mean(dim=0)
    turns, shifts = movements(recording.tracks, bent.tracks, centre)
    assert math.degrees(np.sqrt(np.mean(turns**2))) == pytest.approx(TURN_DEGREES, rel=0.1)
    assert 1e3 * np.sqrt(np.mean(shifts**2)) == pytest.approx(SHIFT_MM, rel=0.1)
    errors = values_of(bent.tracks) - values_of(recording.tracks)
    spread = values_of(recording.tracks).std(dim=0)
    for part in (EXPRESSION, EYELIDS):
        shares = errors[:, part].square().mean(dim=0).sqrt() / spread[part]
        assert shares.tolist() == pytest.approx([COEFFICIENT_SHARE] * len(shares), rel=0.2)
    assert torch.equal(bent.tracks["neck"], recording.tracks["neck"]) and not errors[:, NECK].any()
    assert torch.equal(bent.tracks["shape"], recording.tracks["shape"])


def test_it_is_the_same_for_a_seed(avatar: Avatar, recording: Recording) -> None:
    first, again, other = (perturbed(recording, avatar.head, seed) for seed in (1, 1, 2))
    assert torch.equal(first.tracks["t"], again.tracks["t"]) and not torch.equal(first.tracks["t"], other.tracks["t"])


def test_most_of_the_noise_drifts_and_a_fifth_does_not() -> None:
    noise = tracking_noise(np.random.default_rng(0), 40_000, 1, 25.0)[:, 0]
    assert float(noise.std()) == pytest.approx(1.0, rel=0.05)
    fourth = noise[4:] - 4 * noise[3:-1] + 6 * noise[2:-2] - 4 * noise[1:-3] + noise[:-4]
    assert float(fourth.std()) / math.sqrt(70) == pytest.approx(0.2, rel=0.1)
    assert float((noise[20:] * noise[:-20]).mean()) > 0.3 > float((noise[60:] * noise[:-60]).mean())


def test_vertex_errors_are_in_the_videos_pixels(avatar: Avatar) -> None:
    truth = drawn_clip(avatar, frames=4, train=2).recording
    off = replace(truth, tracks={**truth.tracks, "t": truth.tracks["t"] + torch.tensor([0.002, 0.0, 0.0])})
    assert vertex_error(avatar.head, off, truth) == pytest.approx(truth.intrinsics[0] * 0.002 / 0.8, rel=0.1)
    assert vertex_error(avatar.head, truth, truth) == 0.0


def test_the_share_recovered_and_the_report() -> None:
    rows = [
        Row("as given", Figures(28.0, 0.9, 0.05), 0.0),
        Row("given, refined", Figures(28.5, 0.9, 0.05), 0.1),
        Row("disturbed", Figures(25.0, 0.8, 0.05), 0.8),
        Row("disturbed, refined", Figures(27.4, 0.9, 0.05), 0.3),
    ]
    assert recovered(rows) == pytest.approx(0.8)
    config = SimpleNamespace(trainer=SimpleNamespace(iterations=1500, max_epochs=None))
    text = report(rows, config)  # type: ignore[arg-type]
    assert "1500 steps" in text[0] and "80% of the PSNR lost" in text[-1]
    assert text[5].split() == ["disturbed,", "refined", "27.40", "0.9000", "0.300"]


@pytest.mark.slow
def test_a_quick_run_leaves_its_figures_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "QUICK", ("data.size=40", "model.uv_size=20", "model.mlp_width=16"))
    folder = write_tracked_folder(tmp_path / "someone", frames=20, size=48)
    words = ["bench", "refine", str(folder), "--quick", "--frame-offset", "1", "trainer.iterations=20"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    written = json.loads((tmp_path / "out" / "bench_refine_someone.json").read_text())
    assert [row["tracking"] for row in written["rows"]] == [
        "as given",
        "given, refined",
        "disturbed",
        "disturbed, refined",
    ]
    first, _, bent, again = written["rows"]
    assert first["pixels"] == 0.0 < bent["pixels"]
    assert written["config"]["data"]["size"] == 40 and written["disturbance"]["degrees"] == TURN_DEGREES
    assert f"{again['figures']['psnr']:.2f}" in capsys.readouterr().out
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert left == ["bench_refine_someone.json", "bench_refine_someone.md"]
