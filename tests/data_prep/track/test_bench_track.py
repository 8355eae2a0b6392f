"""The figures and the report of the benchmark of tracking, and a tiny run of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tracked_folder import write_tracked_folder

from avatar.bench.figures import Figures
from avatar.bench.reprojection import Placement, in_parts, placement
from avatar.bench.track import Result, paired, report, with_true_tracking
from avatar.cli import main
from avatar.config import load_config
from avatar.data.recording import Recording
from avatar.data.split import Split
from avatar.demo.identity import sample_identity
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.subject import make_subject
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.types import HeadParams

FRAMES, SIZE, SEED = 4, 256, 1


@pytest.fixture(scope="module")
def assets(demo_head_model: Path) -> HeadAssets:
    return load_head_assets(demo_head_model)


@pytest.fixture
def truth() -> Recording:
    performance = perform(SEED, FRAMES, "speech")
    params = [frame_params(performance, n) for n in range(FRAMES)]
    cameras = [frame_camera(performance, n, SIZE) for n in range(FRAMES)]
    tracks = {name: torch.stack([getattr(p, name) for p in params]) for name in HeadParams.__dataclass_fields__}
    tracks |= {"R": torch.stack([c.R_cam_world for c in cameras]), "t": torch.stack([c.t_cam_world for c in cameras])}
    tracks |= {"shape": torch.from_numpy(sample_identity(SEED).shape)}
    c = cameras[0]
    names = tuple(f"{n + 1:05d}" for n in range(FRAMES))
    split = Split((0, 1), (2, 3))
    return Recording("true", 25.0, SIZE, SIZE, (c.fx, c.fy, c.cx, c.cy), names, split, tracks, "", "")


def test_frames_are_paired_by_their_numbers(truth: Recording) -> None:
    own = replace(truth, names=("00000", "00002", "00003", "00009"))
    assert paired(own, len(truth.names)) == [(0, 0), (1, 2), (2, 3)]


def test_the_true_tracking_goes_to_the_videos_frames(truth: Recording) -> None:
    own = replace(truth, names=("00001", "00003"), intrinsics=(1.0, 1.0, 1.0, 1.0))
    given = with_true_tracking(own, truth, paired(own, FRAMES))
    assert given.names == own.names and given.intrinsics == truth.intrinsics
    assert torch.equal(given.tracks["t"], truth.tracks["t"][[1, 3]])
    assert torch.equal(given.identity, truth.identity)


def test_errors_are_shares_of_the_distance_between_the_eyes(truth: Recording, assets: HeadAssets) -> None:
    pairs = [(n, n) for n in range(FRAMES)]
    assert placement(assets, truth, truth, pairs) == Placement(0.0, 0.0)
    aside = torch.tensor([0.001, 0.0, 0.0])
    off = placement(assets, replace(truth, tracks={**truth.tracks, "t": truth.tracks["t"] + aside}), truth, pairs)
    # A millimetre, of about 63 between the eyes.
    assert 1.3 < off.all < 1.9 and off.moving < 0.1
    swinging = torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None] * aside
    off = placement(assets, replace(truth, tracks={**truth.tracks, "t": truth.tracks["t"] + swinging}), truth, pairs)
    assert off.all == pytest.approx(off.moving, rel=0.02)


@pytest.mark.parametrize("regions", [{}, {"face": torch.zeros(0, dtype=torch.int64)}])
def test_a_head_model_that_names_no_face_is_measured_everywhere(
    regions: dict[str, torch.Tensor], truth: Recording, assets: HeadAssets
) -> None:
    pairs = [(n, n) for n in range(FRAMES)]
    assert placement(replace(assets, regions=regions), truth, truth, pairs) == Placement(0.0, 0.0)


def test_what_is_the_same_in_all_frames_is_told_apart() -> None:
    residuals = np.zeros((2, 1, 2))
    residuals[:, 0] = [[3.0, 5.0], [3.0, 3.0]]
    found = in_parts(residuals)
    assert (found.all, found.moving) == pytest.approx((np.mean([34**0.5, 18**0.5]), 1.0))


def test_the_report_has_every_figure() -> None:
    avatars = {"true": Figures(30.0, 0.95, 0.05), "automatic": Figures(27.75, 0.9, 0.05)}
    first, vertices, refined = Placement(2.3, 1.1), Placement(2.1, 0.6), Placement(1.8, 0.4)
    result = Result("someone", (64, 48), 10, first, vertices, refined, 0.97, avatars)
    assert result.gap("automatic") == pytest.approx(2.25)
    text = "\n".join(report([result], load_config(["data.size=32", "trainer.iterations=5"])))
    for part in (
        "Held-out frames at 32 px, head alone, 5 steps",
        "someone: 10 frames of 64x48",
        "by landmarks 2.30 (1.10), tracked 2.10 (0.60), refined 1.80 (0.40)",
        "0.970",
    ):
        assert part in text
    line = next(line for line in text.splitlines() if "automatic" in line)
    assert line.split() == ["automatic", "27.75", "2.25", "0.9000"]


@pytest.mark.slow
def test_a_tiny_run(tracking_models: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "track", "--quick", "--out", str(tmp_path)]) == 0
    (subject,) = json.loads((tmp_path / "bench_track.json").read_text())["subjects"]
    assert (subject["name"], subject["frames"], subject["size"]) == ("demo-1", 14, [192, 192])
    assert 0.0 < subject["vertices"]["moving"] < subject["vertices"]["all"] < 4.0
    assert 0.0 < subject["first_vertices"]["moving"] != subject["vertices"]["moving"]
    assert subject["head"] > 0.95
    assert set(subject["avatars"]) == {
        "true",
        "true, video's pictures",
        "automatic",
        "refined once",
        "refined twice",
    }
    assert f"{subject['avatars']['automatic']['psnr']:.2f}" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bench_track.json", "bench_track.md"]


@pytest.mark.slow
def test_a_tiny_run_of_a_folder(tracking_models: None, tmp_path: Path) -> None:
    folder = make_subject(tmp_path / "someone", 14, 192, seed=2)
    out = tmp_path / "out"
    assert main(["bench", "track", str(folder), "--quick", "--out", str(out)]) == 0
    (subject,) = json.loads((out / "bench_track_someone.json").read_text())["subjects"]
    assert (subject["name"], subject["frames"]) == ("someone", 14)
    assert 0.0 < subject["vertices"]["all"] < 4.0 and subject["head"] > 0.95


def test_a_folder_must_fit_a_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tracked_folder(tmp_path / "odd", frames=20, size=64, height=63)
    assert main(["bench", "track", str(folder), "--quick", "--out", str(tmp_path / "out")]) == 1
    assert f"{folder} has frames of 64x63 pixels; a video's are even both ways" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["bench", "track", str(folder), str(folder)])
    assert "bench track takes [SUBJECT], 2 given" in capsys.readouterr().err
