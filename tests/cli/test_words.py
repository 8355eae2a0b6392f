"""What is typed as a person means it: no command at all, one that is misspelt, paths where others have options."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from command_line import avatar
from small_runs import QUICK

from avatar.commands.arguments import is_override, parse
from avatar.runs.checkpoint import list_checkpoints, newest_checkpoint


def test_the_program_alone_prints_its_help() -> None:
    output = avatar()
    assert output == avatar("--help") and "doctor" in output and "avatar demo OUT" in output


@pytest.mark.parametrize(
    ("word", "nearest"), [("trian", "train"), ("Train", "train"), ("reenakt", "reenact"), ("exprot", "export")]
)
def test_a_misspelt_command_is_answered_with_the_nearest(word: str, nearest: str) -> None:
    output = avatar(word, "--size", 3, status=2)
    assert f"no command '{word}'" in output and f"nearest is {nearest}" in output and "invalid choice" not in output


def test_a_command_that_is_like_none_is_refused_without_a_guess() -> None:
    output = avatar("xyzzy", status=2)
    assert "no command 'xyzzy'" in output and "nearest" not in output and "avatar --help" in output


def test_a_misspelt_option_is_answered_with_the_nearest() -> None:
    assert "--itrations; the nearest is --iterations" in avatar("train", "me", "--itrations", 5, status=2)
    assert "--drivr=you; the nearest is --driver" in avatar("reenact", "me", "--drivr=you", status=2)


@pytest.mark.parametrize(
    ("words", "folder", "overrides"),
    [
        ("me experiment=demo", "me", ["experiment=demo"]),
        ("experiment=demo me trainer.seed=1", "me", ["experiment=demo", "trainer.seed=1"]),
        ("./a=b", "a=b", []),
        ("runs/x=1/me experiment=demo", "runs/x=1/me", ["experiment=demo"]),
        ("/data/a=b.mp4", "/data/a=b.mp4", []),
        ("take-2=final --out x experiment=demo", "take-2=final", ["experiment=demo"]),
        ("here=now", "here=now", []),
        ("me nowhere=now", "me", ["nowhere=now"]),
        ("me experiment=paper", "me", ["experiment=paper"]),
    ],
)
def test_a_path_with_an_equals_sign_is_no_override(
    words: str, folder: str, overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plain word with the sign is a path where it is there and its first part is no key."""
    monkeypatch.chdir(tmp_path)
    for name in ("here=now", "experiment=paper"):
        (tmp_path / name).mkdir()
    arguments = parse(["train", *words.split()])
    assert arguments.paths == [Path(folder)] and arguments.overrides == overrides
    assert parse(["bench", "train", *words.split()]).inputs == [Path(folder)]


def test_an_override_may_be_longer_than_a_file_name() -> None:
    assert is_override(f"data.test_cameras={','.join(f'2222000{n:02}' for n in range(36, 67))}")


def test_a_folder_with_an_equals_sign_is_trained_on(tracked_folder: Path, tmp_path: Path) -> None:
    folder, run = tmp_path / "a=b", tmp_path / "run=1"
    folder.symlink_to(tracked_folder)
    avatar("train", folder, "--out", run, "--frame-offset", 1, *QUICK, "trainer.iterations=2")
    assert newest_checkpoint(run).step == 2


def test_a_driver_needs_no_option() -> None:
    for words in ("RUN me.mp4", "RUN --driver me.mp4", "RUN --camera target me.mp4", "--camera target RUN me.mp4"):
        arguments = parse(["reenact", *words.split()])
        assert (arguments.run, arguments.driver) == (Path("RUN"), Path("me.mp4"))
    for words, given in (("RUN", 0), ("RUN me you", 2), ("RUN me --driver you", 2)):
        assert f"reenact takes one DRIVER after the AVATAR, {given} given" in avatar(
            "reenact", *words.split(), status=2
        )


def test_a_part_of_the_benchmark_takes_its_own_number_of_folders(capsys: pytest.CaptureFixture[str]) -> None:
    assert parse(["bench", "quality", "a", "b", "c"]).inputs == [Path("a"), Path("b"), Path("c")]
    assert [len(parse(["bench", "track", *words]).inputs) for words in ([], ["a"])] == [0, 1]
    for words, said in ((["quality"], "RUN..., 0 given"), (["render", "a", "b"], "RUN, 2 given")):
        with pytest.raises(SystemExit):
            parse(["bench", *words])
        assert f"bench {words[0]} takes {said}" in capsys.readouterr().err


@pytest.fixture
def begun(trained: Path, tmp_path: Path) -> Path:
    """A run of 16 steps that was interrupted at 12."""
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    list_checkpoints(run / "checkpoints")[-1].unlink()
    return run


@pytest.mark.parametrize("words", ["--resume {run}", "{run} --resume", "{data} --resume {run}", "--resume --out {run}"])
def test_a_run_is_resumed_by_its_name(words: str, begun: Path, tracked_folder: Path) -> None:
    output = avatar("train", *words.format(run=begun, data=tracked_folder).split())
    assert f"Resuming {begun} at step 12 of 16" in output and newest_checkpoint(begun).step == 16


def test_paths_of_which_none_or_several_are_the_run_are_refused(begun: Path, tracked_folder: Path) -> None:
    assert f"{begun} is a run: add --resume" in avatar("train", begun, status=1)
    both = avatar("train", "--resume", begun, "--out", begun.parent / "other", status=1)
    assert f"{begun} are two runs" in both
    assert "is a run: say which" in avatar("train", tracked_folder, tracked_folder, "--resume", status=1)
    assert "3 paths are given" in avatar("train", "a", "b", "c", "--resume", status=2)
    assert newest_checkpoint(begun).step == 12
