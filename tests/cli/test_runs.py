"""A run over time: interrupted, resumed, moved, opened by two, taken away."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import avatar
from small_runs import SMALL, train_small
from torch import Tensor
from tracked_folder import write_tracked_folder

from avatar.commands.arguments import parse
from avatar.commands.train import refuse_other_source
from avatar.data.loader import FrameLoader
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files.lock import locked
from avatar.gaussians.base_model import Avatar
from avatar.losses.lpips import save_lpips
from avatar.losses.lpips_network import Lpips
from avatar.pipeline.open_inputs import at_new_place, moved_source
from avatar.runs.checkpoint import Checkpoint, list_checkpoints, newest_checkpoint, save_checkpoint
from avatar.runs.run import read_run_info
from avatar.train import trainer

OPTIONS = ("--frame-offset", "1", *SMALL)


@pytest.fixture
def own_folder(tmp_path: Path) -> Path:
    return write_tracked_folder(tmp_path / "someone", frames=12, size=48)


@pytest.fixture
def begun(own_folder: Path, tmp_path: Path) -> Path:
    """A run of 12 steps, with its checkpoints of steps 4 and 8 and the video beside it."""
    return train_and_stop(own_folder, tmp_path / "run")


@pytest.fixture(scope="module")
def kept_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("kept") / "someone", frames=12, size=48)


@pytest.fixture(scope="module")
def kept(kept_folder: Path) -> Path:
    """The same for tests that are refused, so that it stays as it is."""
    return train_and_stop(kept_folder, kept_folder.parent / "run")


def train_and_stop(folder: Path, run: Path) -> Path:
    avatar("train", folder, "--out", run, *OPTIONS)
    list_checkpoints(run / "checkpoints")[-1].unlink()
    return run


def weights(place: Path) -> None:
    place.mkdir()
    save_lpips(Lpips("squeeze"), place / "lpips_squeeze.safetensors")


def test_a_run_begun_without_weights_goes_on_without_them(
    begun: Path, own_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights(tmp_path / "weights")
    monkeypatch.setenv("AVATAR_LPIPS", str(tmp_path / "weights"))
    output = avatar("train", own_folder, "--out", begun, "--resume")
    assert "at step 8 of 12" in output and "D-SSIM in place of LPIPS" not in output
    assert read_run_info(begun).perceptual == newest_checkpoint(begun).meta["perceptual"] == "dssim"


def test_a_run_begun_with_weights_does_not_go_on_without_them(
    own_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights(tmp_path / "weights")
    monkeypatch.setenv("AVATAR_LPIPS", str(tmp_path / "weights"))
    run = tmp_path / "run"
    avatar("train", own_folder, "--out", run, *OPTIONS)
    list_checkpoints(run / "checkpoints")[-1].unlink()
    assert read_run_info(run).perceptual == "lpips-squeeze"
    monkeypatch.setenv("AVATAR_LPIPS", str(tmp_path / "nothing"))
    output = avatar("train", own_folder, "--out", run, "--resume", status=1)
    assert "the run began with LPIPS and cannot go on without it" in output
    assert newest_checkpoint(run).step == 8


@pytest.mark.usefixtures("ctrl_c_works")
def test_a_run_that_is_stopped_at_once_says_what_is_saved(
    own_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, draw = tmp_path / "run", trainer.render_held_out

    def ctrl_c_twice(
        avatar: Avatar, loader: FrameLoader, subject: Subject, background: Tensor, step: int
    ) -> tuple[Tensor, Tensor]:
        if step == 8:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        return draw(avatar, loader, subject, background, step)

    monkeypatch.setattr(trainer, "render_held_out", ctrl_c_twice)
    output = avatar("train", own_folder, "--out", run, *OPTIONS, status=130)
    assert f"Interrupted at once; the last checkpoint in {run} is of step 4." in output
    assert output.endswith("Add --resume to the same command to go on.\n")
    monkeypatch.undo()
    assert "at step 4 of 12" in avatar("train", own_folder, "--out", run, *OPTIONS, "--resume")


CHANGES = {
    "another model": (["model=flashavatar"], "began with model=hypergaussians, not flashavatar"),
    "a recipe": (["experiment=paper"], "began with experiment=none, not paper"),
    "another key": (["trainer.seed=5"], "began with trainer.seed=0, not 5"),
    "another size": (["--size", "40"], "began with data.size=None, not 40"),
    "another offset": (["--frame-offset", "2"], "began with --frame-offset 1, not with --frame-offset 2"),
    "a tracking folder": (["--tracking", "elsewhere"], "began without --tracking, not with --tracking"),
    "a format": (["--data-format", "VHAP"], "began without --data-format, not with --data-format VHAP"),
    "a frame rate": (["--fps", "30"], "began without --fps, not with --fps 30"),
    "more left out": (["--max-left-out", "0.5"], "began with --max-left-out 0.05, not with --max-left-out 0.5"),
    "a wrong head": (["--ignore-misfit"], "began without --ignore-misfit, not with --ignore-misfit: leave"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_a_resumed_run_cannot_change_is_refused(name: str, kept: Path, kept_folder: Path) -> None:
    options, sentence = CHANGES[name]
    assert sentence in avatar("train", kept_folder, "--out", kept, "--resume", *options, status=1)
    assert newest_checkpoint(kept).step == 8


def test_a_zero_that_a_run_began_with_is_named() -> None:
    options = parse(["train", "someone", "--frame-offset", "1"])
    with pytest.raises(UserError, match="began with --frame-offset 0, not with --frame-offset 1"):
        refuse_other_source(Path("run"), Source(Path("someone"), Path("head"), frame_offset=0), options)


def test_a_run_that_has_moved_finds_the_folder_of_its_last_round(begun: Path) -> None:
    info, head = read_run_info(begun), begun.parent / "someone" / "head_model"
    away = replace(info, source=Source(Path("/before/rounds/2/someone"), head))
    with pytest.raises(UserError, match="is gone"):
        moved_source(begun, away, None, None)
    (begun / "rounds" / "2" / "someone" / "frames").mkdir(parents=True)
    assert moved_source(begun, away, None, None) == Source(begun / "rounds" / "2" / "someone", head)
    with pytest.raises(UserError, match="is gone"):
        moved_source(begun, replace(info, source=Source(Path("/before"), head)), None, None)
    inside = Source(old := Path("/before"), old / "head", tracking=old / "tracking")
    assert at_new_place(inside, begun) == Source(begun, inside.head, tracking=begun / "tracking")


def test_what_a_resumed_run_began_with_may_be_said_again(begun: Path, own_folder: Path) -> None:
    same = ("model=hypergaussians", "trainer.seed=0", "--frame-offset", 1, "--max-left-out", 0.05)
    assert "at step 8 of 12" in avatar("train", own_folder, "--out", begun, "--resume", *same)


def test_a_run_of_few_frames_ends_with_its_epochs_and_is_resumed_by_the_same_command(
    own_folder: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    command = ("train", own_folder, "--out", run, *OPTIONS, "data.test_frames=8", "trainer.max_epochs=2")
    output = avatar(*command)
    assert "2 epochs are 8 steps" in output and "8 held out, 8 steps" in output
    assert [path.stem[-2:] for path in list_checkpoints(run / "checkpoints")] == ["04", "08"]
    assert read_run_info(run).config.trainer.iterations == newest_checkpoint(run).step == 8
    list_checkpoints(run / "checkpoints")[-1].unlink()
    assert "at step 4 of 8" in avatar(*command, "--resume")
    fewer = avatar(*command, "trainer.iterations=7", "--resume", status=1)
    assert "began with trainer.iterations=8, not 7" in fewer


@pytest.mark.parametrize("way", [("--device", "cpu"), ("device=cpu",)])
def test_a_run_may_go_on_on_another_device_and_says_so(way: tuple[str, ...], begun: Path, own_folder: Path) -> None:
    newest = newest_checkpoint(begun)
    assert newest.meta["device"] == "cpu"
    elsewhere = Checkpoint(newest.step, newest.tensors, {**newest.meta, "device": "cuda", "threads": 77})
    save_checkpoint(begun / "checkpoints", elsewhere, keep=3)
    output = avatar("train", own_folder, "--out", begun, "--resume", *way)
    notes = [line for line in output.splitlines() if line.startswith("Note: the checkpoint was made")]
    assert "on cuda, this is cpu" in notes[1] and "with 77 threads" in notes[0]
    assert all("pictures" in note and "parameters" in note for note in notes), "those differ by more than rounding"
    assert newest_checkpoint(begun).step == 12


@pytest.mark.parametrize("way", [("--device", "cuda:99"), ("device=cuda:99",)])
def test_a_gpu_that_is_asked_for_by_name_is_used_or_refused(
    way: tuple[str, ...], kept: Path, kept_folder: Path
) -> None:
    for command in (
        ("train", kept_folder, "--out", kept, "--resume"),
        ("train", kept_folder, "--out", kept.parent / "new"),
    ):
        output = avatar(*command, *way, status=1)
        assert "\navatar: " in f"\n{output}" and "Resuming" not in output
    assert newest_checkpoint(kept).step == 8 and not list((kept.parent / "new").rglob("*.safetensors"))


@pytest.mark.parametrize(
    "command", ["eval {}", "refine {} --out {}-refined", "view {}", "bench render {} --out {}-bench"]
)
def test_other_commands_too_use_or_refuse_a_gpu(command: str, kept: Path) -> None:
    before = sorted(kept.rglob("*"))
    output = avatar(*command.replace("{}", str(kept)).split(), "--device", "cuda:99", status=1)
    assert "\navatar: " in f"\n{output}" and "Traceback" not in output
    assert sorted(kept.rglob("*")) == before and not list(kept.parent.glob(f"{kept.name}-*"))


@pytest.mark.slow
def test_two_trainings_into_one_folder_are_one_too_many(own_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = [sys.executable, "-m", "avatar.cli", "train", str(own_folder), "--out", str(run), *OPTIONS]
    first = subprocess.Popen(
        [*command, "trainer.iterations=100000"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        deadline = time.monotonic() + 120
        while not (run / "run.json").is_file() and time.monotonic() < deadline:
            time.sleep(0.01)
        recorded = (run / "run.json").read_bytes()
        for options in (OPTIONS, ("--resume",)):
            output = avatar("train", own_folder, "--out", run, *options, status=1)
            assert f"{run} is being written by process {first.pid} on " in output
        assert (run / "run.json").read_bytes() == recorded
    finally:
        first.send_signal(signal.SIGKILL)
        first.wait()
    with locked(run):  # the system has let go of it
        pass
    assert not (run / ".lock").exists()


def test_a_lock_is_held_once(tmp_path: Path) -> None:
    with (
        locked(tmp_path / "run"),
        pytest.raises(UserError, match="is being written by process"),
        locked(tmp_path / "run"),
    ):
        raise AssertionError("the lock was taken twice")
    (tmp_path / "kept").mkdir()
    with locked(tmp_path / "kept" / "runs" / "run"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]  # and nothing that was made for the lock
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"), locked(tmp_path / "file" / "run"):
        pass


def test_an_avatar_needs_neither_its_video_nor_its_run(tracked_folder: Path, tmp_path: Path) -> None:
    """The video is moved away, the file copied elsewhere: both still draw, and to the same bits."""
    folder = Path(shutil.copytree(tracked_folder, tmp_path / "someone"))
    driver = write_tracked_folder(tmp_path / "driver", frames=8, size=48, seed=5)
    run = tmp_path / "run"
    train_small(folder, run)
    head = Path(shutil.copytree(folder / "head_model", tmp_path / "head"))
    folder.rename(tmp_path / "moved")

    output = avatar("reenact", run, "--driver", driver, "--frame-offset", 1, status=1)
    assert "needs its head model (that of the training, " in output and "is gone): give --head PATH" in output
    avatar("reenact", run, "--head", head, "--driver", driver, "--frame-offset", 1)
    empty = tmp_path / "empty"
    empty.mkdir()
    avatar("drive-file", driver, "--frame-offset", 1, "--out", empty / "motion.npz")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(empty)
        avatar("reenact", run / "avatar.safetensors", "--head", head, "--driver", "motion.npz")
        assert (empty / "reenact" / "motion-relative.mp4").stat().st_size > 1000
        avatar("export", run, "--head", head, "--with-head", "--out", "alone.safetensors")
        output = avatar("reenact", "alone.safetensors", "--driver", "motion.npz", "--out", "alone.mp4")
    assert (empty / "alone.mp4").read_bytes() == (empty / "reenact" / "motion-relative.mp4").read_bytes()
    recorded = json.loads((empty / "alone.choices.json").read_text())
    assert recorded["avatar"]["file"] == str(empty / "alone.safetensors")

    gone = avatar("eval", run, "--head", head, "--protocol", "strict", status=1)
    assert f"{folder}, on which {run} was trained, is gone: give its new place with --folder" in gone
    measured = avatar("eval", run, "--head", head, "--folder", tmp_path / "moved", "--protocol", "strict")
    assert "strict" in measured
    avatar("report", run, "--head", head, "--folder", tmp_path / "moved")
    other = write_tracked_folder(tmp_path / "other", frames=30, size=48, seed=9)
    refused = avatar("eval", run, "--head", head, "--folder", other, status=1)
    assert f"the data of other is not what {run} was trained on" in refused


def test_a_moved_video_is_resumed_from_its_new_place(begun: Path, own_folder: Path, tmp_path: Path) -> None:
    moved = own_folder.rename(tmp_path / "moved")
    assert "is gone: give its new place" in avatar("train", "--out", begun, "--resume", status=1)
    output = avatar("train", "--out", begun, "--resume", "--folder", moved)
    assert "at step 8 of 12" in output, "its head model lies inside it"
    assert "Results" in avatar("eval", begun, "--folder", moved, "--protocol", "strict")


def test_a_head_model_that_stayed_behind_is_still_found(begun: Path, own_folder: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(own_folder, moved, ignore=shutil.ignore_patterns("head_model"))
    assert "at step 8 of 12" in avatar("train", "--out", begun, "--resume", "--folder", moved)
