"""What the program says before it does anything: groups of commands, completions, a plan and a configuration."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from command_line import avatar

from avatar.commands.arguments import parse
from avatar.commands.groups import GROUPS
from avatar.commands.outputs import check_outputs
from avatar.commands.parser import build_parser
from avatar.config import load_config
from avatar.pipeline.dry_run import as_duration


def test_every_command_is_in_one_group_with_an_example() -> None:
    _, commands = build_parser()
    named = [name for group in GROUPS.values() for name in group]
    assert sorted(named) == sorted(set(commands) - {"sweep-job"})
    overview = avatar("--help")
    for group in GROUPS.values():
        for name, (meaning, example) in group.items():
            assert meaning in overview and f"avatar {name} {example}".rstrip() in overview
            said = " ".join(avatar(name, "--help").split())
            assert f"example: avatar {name} {example}".rstrip() in said


def test_the_examples_write_beside_their_inputs() -> None:
    for name, example in ((name, told) for group in GROUPS.values() for name, (_, told) in group.items()):
        words = example.partition(">>")[0].split()
        if (out := getattr(parse([name, *words]), "out", None)) is not None and "--out" in words:
            check_outputs([Path(out)], [Path(words[0])])


COMPLETE = """source {script}
COMP_WORDS=({words}); COMP_CWORD=$(({count} - 1)); _avatar; echo "${{COMPREPLY[@]}}" """


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("avatar", "reen"), "reenact"),
        (("avatar", "train", "--dry"), "--dry-run"),
        (("avatar", "export", "--format", "web"), "web web-avatar"),
        (("avatar", "train", "trainer.iter"), "trainer.iterations="),
        (("avatar", "completion", "f"), "fish"),
    ],
)
def test_bash_completes(words: tuple[str, ...], expected: str, tmp_path: Path) -> None:
    script = tmp_path / "avatar.bash"
    script.write_text(avatar("completion", "bash"))
    typed = COMPLETE.format(script=script, words=" ".join(words), count=len(words))
    done = subprocess.run(["bash", "-c", typed], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == expected and not done.stderr


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_theirs(shell: str, tmp_path: Path) -> None:
    said = avatar("completion", shell)
    assert {"zsh": "bashcompinit", "fish": "complete -c avatar"}[shell] in said and "dry-run" in said
    if (found := shutil.which(shell)) is not None:
        (tmp_path / "script").write_text(said)
        subprocess.run([found, "-n", str(tmp_path / "script")], check=True)


def test_a_dry_run_says_what_it_takes_and_writes_nothing(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = avatar("train", tracked_folder, "--dry-run", "trainer.iterations=20", "model.uv_size=16")
    for fact in ("frames to train on", "minutes: 20 steps", "Memory", "Disk", "model.uv_size=16"):
        assert fact in said
    assert list(tmp_path.iterdir()) == []
    refused = avatar("train", tracked_folder, "--dry-run", "--refine", 1, "model=gaussianheadavatar", status=1)
    assert "--refine" in refused
    assert "is a video" in avatar("train", (film := tmp_path / "a.mp4").touch() or film, "--dry-run", status=1)


@pytest.mark.parametrize(
    ("seconds", "words"), [(90.0, "1.5 minutes"), (7190.0, "119.8 minutes"), (7200.0, "2.0 hours"), (1e8, "1,157 days")]
)
def test_a_dry_run_names_the_time_in_a_fitting_unit(seconds: float, words: str) -> None:
    assert as_duration(seconds) == words


def test_the_printed_configuration_is_one_to_type() -> None:
    cameras = ",".join(f"2222000{number}" for number in range(10, 20))
    asked = ["experiment=paper", "trainer.seed=3", "data.background=#123456", f"data.test_cameras={cameras}"]
    lines = avatar("train", "--print-config", *asked).splitlines()
    assert "trainer.seed=3" in lines and load_config(lines) == load_config(asked)
    assert "takes one SUBJECT, 2 given" in avatar("train", "anna", "carla", "--print-config", status=2)


@pytest.mark.parametrize("option", ["--print-config", "--dry-run"])
def test_a_printed_configuration_is_not_taken_for_a_runs(option: str, tmp_path: Path) -> None:
    assert f"{option} is for a new run" in avatar("train", tmp_path, "--resume", option, status=1)
