"""Mistakes at the command line: one sentence, a status, and nothing lost."""

from __future__ import annotations

import shutil
import subprocess
import sys
import urllib.error
from pathlib import Path

import pytest
from command_line import avatar
from small_runs import QUICK, SMALL
from tracked_folder import write_tracked_folder

from avatar.runs.checkpoint import list_checkpoints


def fresh_copy(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "run"))


def _no_network(*_: object, **__: object) -> None:
    raise urllib.error.URLError("no network")


MISTAKES = {
    "no such folder": (["train", "{tmp}/nothing"], "nothing does not exist"),
    "no such video": (["train", "{tmp}/nothing.mp4"], "nothing.mp4 does not exist"),
    "no such folder to prepare": (["prepare", "{tmp}/nothing"], "nothing does not exist"),
    "no such video as driver": (["reenact", "{run}", "{tmp}/x.mp4"], "x.mp4 does not exist"),
    "no such sweep": (["sweep", "{tmp}/x.yaml"], "x.yaml does not exist"),
    "a folder of runs": (["view", "{run}/.."], "holds {run}/../run"),
    "eval of a folder of runs": (["eval", "{run}/.."], "holds {run}/../run"),
    "nothing to train on": (["train", "{tmp}"], "{tmp} is empty; docs/data.md says what belongs to a tracked folder"),
    "no head model": (["train", "{bare}"], "no head model for {bare}: give --head PATH, or set AVATAR_HEAD"),
    "head model gone": (["train", "{data}", "--head", "{tmp}/x.pkl"], "x.pkl does not exist; give --head"),
    "unknown key": (["train", "{data}", "trainer.iteration=5"], "the nearest is 'trainer.iterations'"),
    "bad size": (["train", "{data}", "--size", "3"], "--size=3 is out of range"),
    "no iterations": (["train", "{data}", "--iterations", "0"], "--iterations=0 is out of range"),
    "run exists": (["train", "{data}", "--out", "{run}"], "holds a run already: add --resume"),
    "nothing to resume": (["train", "{data}", "--out", "{tmp}/new", "--resume"], "is not a run folder"),
    "resume with another key": (
        ["train", "{data}", "--out", "{run}", "--resume", "model.latent_dim=4"],
        "began with model.latent_dim=8, not 4",
    ),
    "resume of other data": (
        ["train", "{twin}", "--out", "{run}", "--resume"],
        "the data of twin is not what {run} was trained on",
    ),
    "resume with another head": (
        ["train", "{data}", "--out", "{run}", "--resume", "--head", "{other}/head_model"],
        "trained with another head model",
    ),
    "eval of no run": (["eval", "{tmp}"], "is not a run folder: it has no run.json"),
    "reenactment of no avatar": (["reenact", "{tmp}", "--driver", "{data}"], "is neither a run nor an avatar file"),
    "reenactment of a missing avatar": (["reenact", "{tmp}/x", "{data}"], "x does not exist"),
    "a missing run beside another": (["compare", "{run}", "{tmp}/x"], "x does not exist"),
    "eval with another head": (["eval", "{run}", "--head", "{other}/head_model"], "trained with another head model"),
    "unknown protocol": (["eval", "{run}", "--protocol", "paper"], "paper"),
    "driver gone": (["reenact", "{run}", "--driver", "{tmp}/nobody"], "nobody does not exist"),
    "driver of another head": (
        ["reenact", "{run}", "--driver", "{other}", "--frame-offset", "1"],
        "was tracked with another head model",
    ),
    "a folder and another --folder": (["train", "{data}", "--folder", "{twin}"], "twin are two folders"),
    "a drive file read as a folder": (
        ["reenact", "{run}", "{motion}", "--fps", "50"],
        "--fps is for tracked folders, and {motion} is a drive file",
    ),
    "a cluster's address for this machine": (
        ["sweep", "--out", "{tmp}/sweep", "--address", "head:1"],
        "--address is for --engine ray or slurm, not for local",
    ),
    "LPIPS without weights": (
        ["train", "{data}", "--frame-offset", "1", "--out", "{tmp}/l", "trainer.perceptual=lpips-squeeze", *QUICK],
        "fetch it by other means to",
    ),
}


@pytest.fixture(scope="module")
def other_head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A driver whose head model has another expression basis."""
    return write_tracked_folder(tmp_path_factory.mktemp("other") / "other", frames=6, size=48, expressions=12)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another video of the same head model."""
    return write_tracked_folder(tmp_path_factory.mktemp("twin") / "twin", frames=30, size=48, seed=9)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_gets_one_sentence_and_a_status(
    mistake: str,
    trained: Path,
    tracked_folder: Path,
    other_head: Path,
    twin: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arguments, sentence = MISTAKES[mistake]
    bare = tmp_path / "bare"
    if "{bare}" in "".join(arguments):  # a tracked folder without a head model
        (bare / "imgs").mkdir(parents=True)
    if "{motion}" in arguments:
        (tmp_path / "motion.csv").touch()
    places = {
        "tmp": tmp_path,
        "bare": bare,
        "data": tracked_folder,
        "run": trained,
        "other": other_head,
        "twin": twin,
        "motion": tmp_path / "motion.csv",
    }
    monkeypatch.setattr("urllib.request.urlopen", _no_network)
    output = avatar(*(a.format(**places) for a in arguments), status=1)
    assert sentence.format(**places) in output
    assert output.strip().splitlines()[-1].startswith("avatar: ")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["train", "."], ""),
        (["train", "nothing"], "nothing does not exist"),
        (["train", ".", "trainer.iteration=5"], "the nearest is 'trainer.iterations'"),
        (["train", ".", "trainer.iterations=0"], "trainer.iterations=0 is out of range"),
        (["sweep", "x.yaml"], "x.yaml does not exist"),
    ],
)
def test_a_wrong_word_is_said_before_pytorch_is_imported(words: list[str], sentence: str, tmp_path: Path) -> None:
    program = f"import sys; from avatar.commands.main import main; main({words}); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert sentence in done.stderr and done.stdout.endswith(f"{not sentence}\n")


def test_a_run_without_a_checkpoint_is_not_evaluated(trained: Path, tmp_path: Path) -> None:
    run = fresh_copy(trained, tmp_path)
    (run / "avatar.safetensors").unlink()
    assert "no checkpoint has been written yet" in avatar("eval", run, status=1)


def test_a_damaged_checkpoint_is_named(trained: Path, tracked_folder: Path, tmp_path: Path) -> None:
    run = fresh_copy(trained, tmp_path)
    newest = list_checkpoints(run / "checkpoints")[-1]
    newest.write_bytes(newest.read_bytes()[:1000])
    assert f"{newest.name} is damaged" in avatar("train", tracked_folder, "--out", run, "--resume", status=1)
    newest.unlink()
    output = avatar("train", tracked_folder, "--out", run, "--resume")  # the one before is whole
    assert "Resuming" in output and "at step 12 of 16" in output


def test_a_damaged_avatar_file_is_named_and_resuming_writes_it_again(
    trained: Path, tracked_folder: Path, tmp_path: Path
) -> None:
    run = fresh_copy(trained, tmp_path)
    file = run / "avatar.safetensors"
    whole = file.read_bytes()
    file.write_bytes(whole[:1000])
    assert "avatar.safetensors is damaged" in avatar("eval", run, status=1)
    assert "is complete (16 steps)" in avatar("train", tracked_folder, "--out", run, "--resume")
    assert file.read_bytes() == whole


def test_data_that_changed_since_training_is_noticed(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "someone", frames=12, size=48)
    run = tmp_path / "run"
    avatar("train", folder, "--out", run, "--frame-offset", 1, *SMALL, "trainer.iterations=2")
    image = folder / "imgs" / "00003.jpg"
    image.write_bytes((folder / "imgs" / "00004.jpg").read_bytes())
    assert "the data of someone is not what" in avatar("eval", run, status=1)
    for number in range(4, 9):
        (folder / "imgs" / f"{number:05d}.jpg").unlink()
    gone = avatar("eval", run, status=1)
    assert f"the data is not what {run} was trained on: restore it" in gone and "--max-left-out" not in gone
