"""What cannot work is refused in a sentence before the first step, and leaves nothing behind."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.compute import memory
from avatar.losses.lpips import save_lpips
from avatar.losses.lpips_network import Lpips
from avatar.runs.avatar_file import read_avatar_file, write_avatar_file

pytestmark = pytest.mark.slow

QUICK = [*SMALL, "trainer.iterations=4"]


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of 16:9."""
    return write_tracked_folder(tmp_path_factory.mktemp("wide") / "wide", frames=12, size=64, height=36)


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights of LPIPS-SqueezeNet, random."""
    folder = tmp_path / "weights"
    folder.mkdir()
    save_lpips(Lpips("squeeze"), folder / "lpips_squeeze.safetensors")
    monkeypatch.setenv("AVATAR_LPIPS", str(folder))


@pytest.mark.parametrize("perceptual", ["auto", "dssim", "none"])
def test_frames_under_eleven_pixels_are_refused_before_the_first_step(
    wide: Path, tmp_path: Path, perceptual: str
) -> None:
    run = tmp_path / "run"
    options = ("--frame-offset", 1, "--out", run, "--size", 16, f"trainer.perceptual={perceptual}", *QUICK)
    output = avatar("train", wide, *options, status=1)
    assert "needs frames of at least 11x11 pixels, these have 16x9; train with --size 21 or more" in output
    assert not run.exists()
    assert "Trained" in avatar("train", wide, *options[:4], "--size", 21, *options[6:])


@pytest.mark.usefixtures("weights")
def test_lpips_on_frames_under_32_pixels_is_refused_by_name_and_replaced_by_itself(wide: Path, tmp_path: Path) -> None:
    options = ("--frame-offset", 1, "--size", 40, *QUICK)
    output = avatar("train", wide, "--out", tmp_path / "a", *options, "trainer.perceptual=lpips-squeeze", status=1)
    assert "LPIPS needs frames of at least 32x32 pixels, these have 40x22; train with --size 60 or more" in output
    assert not (tmp_path / "a").exists()
    output = avatar("train", wide, "--out", tmp_path / "b", *options)
    assert "D-SSIM in place of LPIPS: LPIPS needs frames of at least 32x32 pixels" in output and "Trained" in output
    output = avatar("train", wide, "--out", tmp_path / "c", "--size", 60, *options[:2], *QUICK)
    assert "D-SSIM" not in output and "Trained" in output


@pytest.mark.usefixtures("weights")
def test_a_head_that_is_smaller_than_lpips_sees_is_trained_on(tmp_path: Path) -> None:
    """Head masks of a few pixels, with no margin to speak of: the box is enlarged to 32 pixels."""
    import cv2
    import numpy as np

    folder = write_tracked_folder(tmp_path / "far", frames=12, size=48)
    for path in (folder / "parsing").glob("*_neckhead.png"):
        mask = np.zeros((48, 48), np.uint8)
        mask[:3, :3] = 255
        cv2.imwrite(str(path), mask)
    options = ("--frame-offset", 1, "--ignore-misfit")
    output = avatar("train", folder, "--out", tmp_path / "run", *options, *QUICK)
    assert "Trained" in output


TOO_LARGE = {
    "network": (["model.mlp_width=65536", "model.mlp_layers=1000"], "the deformation network", "model.mlp_width or"),
    "texels": (
        ["model.uv_size=1024", "model.latent_dim=4096"],
        "the HyperGaussians",
        "model.uv_size or model.latent_dim",
    ),
}


@pytest.mark.parametrize("case", TOO_LARGE)
def test_an_avatar_larger_than_the_memory_is_refused_before_anything_is_made(
    case: str, tracked_folder: Path, tmp_path: Path
) -> None:
    overrides, what, lower = TOO_LARGE[case]
    run = tmp_path / "run"
    output = avatar("train", tracked_folder, "--frame-offset", 1, "--out", run, *overrides, status=1)
    assert re.search(r"training needs about [0-9,.]+ GiB of memory, and [0-9.]+ [GM]iB are available", output)
    assert f"; {what} takes " in output
    assert f"lower {lower}" in output and not run.exists()


def test_a_foreign_avatar_file_that_lies_about_its_size_is_refused(tracked_folder: Path, tmp_path: Path) -> None:
    """Its configuration asks for terabytes, its parameters are small: what does not fit together is not built."""
    run = tmp_path / "run"
    avatar("train", tracked_folder, "--frame-offset", 1, "--out", run, *QUICK)
    content = read_avatar_file(run / "avatar.safetensors")
    huge = replace(content.config.model, mlp_width=65536, mlp_layers=1000, uv_size=1024, latent_dim=4096)
    file = tmp_path / "foreign.safetensors"
    write_avatar_file(file, replace(content, config=replace(content.config, model=huge)))
    head = tracked_folder / "head_model"
    output = avatar("reenact", file, "--head", head, "--driver", tracked_folder, "--frame-offset", 1, status=1)
    assert "it belongs to another model" in output and "this model needs" in output


def test_an_avatar_file_larger_than_the_memory_is_refused(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    avatar("train", tracked_folder, "--frame-offset", 1, "--out", run, *QUICK)
    monkeypatch.setattr(memory, "available_bytes", lambda: 2.0**16)
    output = avatar("reenact", run, "--driver", tracked_folder, "--frame-offset", 1, status=1)
    assert re.search(r"opening .*avatar.safetensors needs about [0-9]+ MiB of memory, and 0 MiB are available", output)


@pytest.mark.parametrize(
    ("variable", "value"), [("AVATAR_THREADS", "²"), ("AVATAR_THREADS", "two"), ("AVATAR_SIMD", "neon")]
)
def test_a_variable_that_holds_nonsense_is_a_sentence(
    variable: str, value: str, wide: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, value)
    output = avatar("train", wide, "--frame-offset", 1, "--out", tmp_path / "run", "--size", 24, *QUICK, status=1)
    assert f"avatar: {variable} must be " in output and value in output
