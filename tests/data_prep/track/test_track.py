"""From a video of the demo's person to a folder that others take, once and in stages."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from videos import encode

from avatar.cli import main
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.raw_video import filmed
from avatar.demo.render import render_frame
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.check.folder import check_tracked_folder
from data_prep.formats.avatar_track import read_info
from data_prep.prepare.open_subject import find_head
from data_prep.track import tracking_stages
from data_prep.track.faces.landmarks import load_landmarks
from data_prep.track.footage.picture_folder import is_footage
from data_prep.track.footage.source import Box
from data_prep.track.track import Choices, track

pytestmark = [pytest.mark.usefixtures("tracking_models"), pytest.mark.slow]
FRAMES, SIZE, SEED = 20, 256, 1


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return encode(tmp_path_factory.mktemp("video") / "me.mp4", filmed(FRAMES, SIZE, SEED))


@pytest.fixture(scope="module")
def tracked(video: Path, tracking_models: None, demo_head_model: Path) -> Path:
    out = video.parent / "me"
    said: list[str] = []
    track(video, out, demo_head_model, load_head_assets(demo_head_model), say=said.append)
    (video.parent / "said.txt").write_text("\n".join(said))
    return out


def test_the_folder_is_whole(tracked: Path) -> None:
    info = read_info(tracked)
    assert (info.fps, info.width, info.height, info.left_out) == (25.0, SIZE, SIZE, {})
    assert info.focal_is_assumed and info.intrinsics[2:] == (SIZE / 2, SIZE / 2)
    assert info.source["video"] == "me.mp4" and len(info.source["sha256"]) == 64
    assert info.source["box"] == [0, 0, SIZE, SIZE] and info.source["crop"] == "auto"
    for kind, suffix in (("frames", "jpg"), ("matte", "png"), ("head", "png"), ("mouth", "png")):
        names = sorted(path.name for path in (tracked / kind).iterdir())
        assert names == [f"{n:05d}.{suffix}" for n in range(FRAMES)], kind
    assert len(load_landmarks(tracked / "landmarks.npz")) == FRAMES
    assert {path.name for path in tracked.iterdir()} == {
        "frames", "matte", "head", "mouth", "overlay", "landmarks.npz", "tracking.npz", "tracking.json"
    }  # fmt: skip
    assert {path.name for path in (tracked / "overlay").iterdir()} == {"overlay.mp4", "overlay.jpg"}
    assert not [path for path in tracked.parent.iterdir() if path.name.startswith(".")]


def test_masks_against_the_truth(tracked: Path) -> None:
    performance = perform(SEED, FRAMES, "speech")
    overlaps: dict[str, list[float]] = {"matte": [], "head": [], "mouth": []}
    for n in range(0, FRAMES, 6):
        truth = render_frame(SEED, frame_params(performance, n), frame_camera(performance, n, SIZE))
        for kind, mask in (("matte", truth.alpha), ("head", truth.head), ("mouth", truth.mouth)):
            made = cv2.imread(str(tracked / kind / f"{n:05d}.png"), cv2.IMREAD_GRAYSCALE)
            assert made is not None
            both, either = (made > 127) & (mask > 127), (made > 127) | (mask > 127)
            overlaps[kind].append(float(both.sum() / either.sum()))
    assert np.mean(overlaps["matte"]) > 0.97 and np.mean(overlaps["head"]) > 0.97
    assert np.mean(overlaps["mouth"]) > 0.75


def test_check_finds_nothing_wrong(tracked: Path, demo_head_model: Path) -> None:
    outcome = check_tracked_folder(tracked, lambda: load_head_assets(demo_head_model))
    assert [f.problem for f in outcome.findings if f.severity != "note"] == []


def test_the_quality_is_told(tracked: Path) -> None:
    figures = {figure["name"].strip(): figure for figure in read_info(tracked).quality["figures"]}
    assert figures["frames with a face"]["value"] == 100.0
    assert 0 < figures["landmark error"]["value"] < 2.0
    said = (tracked.parent / "said.txt").read_text()
    assert "quality of the tracking" in said and "frames that fit worst:" in said
    assert f"tracked {FRAMES} frames in" in said and "assumed: the face is 0.9 m away" in said


def test_it_is_done_once(tracked: Path, video: Path, demo_head_model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in tracked.rglob("*")}
    again = ["track", str(video), "--head", str(demo_head_model), "--out", str(tracked)]
    assert main(again) == 0 and f"{tracked} holds this tracking already" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in tracked.rglob("*")} == before
    assert main([*again, "--size", "128"]) == 1
    assert "exists and is not this tracking: choose another --out, or remove it first" in capsys.readouterr().err


def test_an_interrupted_run_goes_on(
    tracked: Path,
    video: Path,
    demo_head_model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    def never(*arguments: object) -> None:
        raise AssertionError("a stage that was complete is made again")

    command = ["track", str(video), "--head", str(demo_head_model), "--out", str(tmp_path / "me")]
    with monkeypatch.context() as patch:
        patch.setattr(tracking_stages, "head_mask", interrupted)
        assert main(command) == 130
    assert "interrupted: the same command goes on after the last stage" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == [".me.partial"]
    with monkeypatch.context() as patch:
        patch.setattr("data_prep.track.track.look_at", never)
        for stage in ("write_frames", "write_mattes", "fit_tracks"):
            patch.setattr(tracking_stages, stage, never)
        assert main(command) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["me"]
    for name in ("tracking.npz", "landmarks.npz", "frames/00003.jpg", "matte/00003.png", "head/00003.png"):
        assert (tmp_path / "me" / name).read_bytes() == (tracked / name).read_bytes(), name  # and to the same bits


def test_the_crop_moves_the_camera_with_it(tracked: Path, video: Path, demo_head_model: Path, tmp_path: Path) -> None:
    """A larger picture around the same person, cut back by --crop, is tracked as the picture itself."""
    framed = [cv2.copyMakeBorder(image, 40, 24, 60, 100, cv2.BORDER_REPLICATE) for image in filmed(FRAMES, SIZE, SEED)]
    large = encode(tmp_path / "large.mp4", framed)
    choices = Choices(crop=Box(60, 40, SIZE, SIZE), focal=600.0)
    head = load_head_assets(demo_head_model)
    info = track(large, tmp_path / "large", demo_head_model, head, choices, say=lambda line: None)
    middle = (SIZE + 160) / 2 - 60, (SIZE + 64) / 2 - 40
    assert info.intrinsics == pytest.approx((600.0, 600.0, *middle)) and not info.focal_is_assumed
    mine, theirs = load_landmarks(tmp_path / "large" / "landmarks.npz"), load_landmarks(tracked / "landmarks.npz")
    assert np.abs(mine.points - theirs.points)[..., :2].mean() < 1.0
    small = track(
        encode(tmp_path / "short.mp4", framed[:10]),
        tmp_path / "small",
        demo_head_model,
        head,
        Choices(Box(60, 40, SIZE, SIZE), 128, focal=600.0),
        lambda s: None,
    )
    assert small.intrinsics == pytest.approx([value / 2 for value in info.intrinsics])


def test_what_is_to_be_tracked(tracked: Path, video: Path, tmp_path: Path) -> None:
    assert (
        is_footage(video) and not is_footage(tracked) and not is_footage(tmp_path) and not is_footage(tmp_path / "no")
    )
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((8, 8, 3), np.uint8))
    assert is_footage(tmp_path)
    (tmp_path / "imgs").mkdir()
    assert not is_footage(tmp_path)
    with pytest.raises(UserError, match="me.mp4 is a file; if it is a video, avatar track makes a tracked folder"):
        find_head(video)


def test_user_mattes_win(video: Path, demo_head_model: Path, tmp_path: Path) -> None:
    performance = perform(SEED, FRAMES, "speech")
    folder = tmp_path / "mattes"
    folder.mkdir()
    for n in range(FRAMES):
        truth = render_frame(SEED, frame_params(performance, n), frame_camera(performance, n, SIZE))
        cv2.imwrite(str(folder / f"{n:03d}.png"), truth.alpha)
    head = load_head_assets(demo_head_model)
    track(video, tmp_path / "me", demo_head_model, head, Choices(matte=folder), say=lambda line: None)
    for n in (0, 17):
        made, given = (
            cv2.imread(str(p), cv2.IMREAD_GRAYSCALE)
            for p in (tmp_path / f"me/matte/{n:05d}.png", folder / f"{n:03d}.png")
        )
        np.testing.assert_array_equal(made, given)
    (folder / "005.png").unlink()
    with pytest.raises(UserError, match="mattes gives 19 pictures where 20 were expected"):
        track(video, tmp_path / "two", demo_head_model, head, Choices(matte=folder), say=lambda line: None)
    with pytest.raises(UserError, match="the mattes in .* are 128x128 pixels, the video 256x256"):
        small = encode(tmp_path / "small.mp4", [np.zeros((128, 128, 3), np.uint8)] * FRAMES)
        track(video, tmp_path / "three", demo_head_model, head, Choices(matte=small), say=lambda line: None)


def test_train_and_reenact_take_videos(
    video: Path, tracking_models: None, demo_head_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = ["--size", "64", "trainer.iterations=8", "model.uv_size=32", "trainer.checkpoint_every=8"]
    run = str(tmp_path / "run")
    assert main(["train", str(video), "--head", str(demo_head_model), "--out", run, *quick]) == 0
    assert f"tracked {FRAMES} frames in" in capsys.readouterr().out
    source = json.loads((tmp_path / "run" / "run.json").read_text())["source"]
    assert source["folder"].endswith(f"tracked/me-{Path(source['folder']).name.partition('-')[2]}")
    assert main(["reenact", run, "--driver", str(video), "--out", str(tmp_path / "out.mp4")]) == 0
    said = capsys.readouterr().out
    assert "using the tracking" in said and f"tracked {FRAMES} frames" not in said
    assert (tmp_path / "out.mp4").is_file()
