"""Evaluating a run protocol by protocol: what was measured before stays while it is true."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import avatar
from small_runs import SMALL

from avatar.commands.held_out_figures import evaluate_or_read, figures_line
from avatar.evaluation import evaluate as evaluate_module
from avatar.evaluation.protocol import builtin_protocols
from avatar.files.lock import locked


@pytest.fixture(scope="module")
def evaluated(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was measured by two protocols."""
    run = tmp_path_factory.mktemp("runs") / "run"
    avatar("train", tracked_folder, "--frame-offset", 1, "--out", run, *SMALL, "trainer.iterations=8")
    avatar("eval", run, "--protocol", "strict", "--protocol", "flashavatar", "--frames")
    return run


@pytest.fixture
def run(evaluated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(evaluated, tmp_path / "run"))


def read_results(run: Path) -> dict[str, Any]:
    return json.loads((run / "eval" / "results.json").read_text())


def tables(run: Path) -> set[str]:
    return {path.parent.name for path in (run / "eval").glob("*/frames.csv")}


def test_a_protocol_more_keeps_the_others_results(run: Path) -> None:
    before = read_results(run)["protocols"]
    output = avatar("eval", run, "--protocol", "rgbavatar")
    after = read_results(run)
    assert list(after["protocols"]) == ["flashavatar", "rgbavatar", "strict"]
    assert {name: after["protocols"][name] for name in before} == before
    assert tables(run) == {"rgbavatar", "strict", "flashavatar"}
    assert len(list((run / "eval" / "strict" / "renders").glob("*.png"))) == 6
    assert "Kept     flashavatar, strict: measured before" in output and "Removed" not in output
    assert [note.split(":")[0] for note in after["notes"]] == ["flashavatar"], "trained over white and black"
    printed = output.partition("Results")[0]
    assert "rgbavatar" in printed and "strict" not in printed, "the table shows what was asked for"
    compared = avatar("compare", run, run)
    assert all(name in compared for name in ("rgbavatar", "strict", "flashavatar"))


def test_what_create_says_of_a_run_is_by_all_protocols(run: Path) -> None:
    """Also where somebody has measured it by one of them before."""
    shutil.rmtree(run / "eval")
    avatar("eval", run, "--protocol", "rgbavatar")
    results = evaluate_or_read(run)
    line, means = figures_line(results), json.loads(results.read_text())["protocols"]["strict"]["means"]
    assert line.startswith(f"PSNR {means['psnr_head']:.2f}, ") and line.endswith("of them, head only")
    assert tables(run) == builtin_protocols().keys()


@pytest.mark.slow
def test_a_protocol_more_replaces_nobodys_curves_sheet_or_video(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plotted: list[tuple[list[str], set[str], str]] = []
    real = evaluate_module.curves

    def watched(protocols: Any, by_drive: Any, shown: str, worst: Any) -> bytes:
        plotted.append(([protocol.name for protocol in protocols], set(by_drive["tracked"]), shown))
        return real(protocols, by_drive, shown, worst)

    monkeypatch.setattr(evaluate_module, "curves", watched)
    pictures = {name: (run / "eval" / name).read_bytes() for name in ("worst.png", "truth_render_error.mp4")}
    output = avatar("eval", run, "--protocol", "rgbavatar")
    every = ["flashavatar", "rgbavatar", "strict"]
    assert plotted == [(every, set(every), "strict")]
    assert {name: (run / "eval" / name).read_bytes() for name in pictures} == pictures
    assert f"Worst (strict) {run / 'eval' / 'worst.png'}" in output and "Video (strict)" in output
    avatar("eval", run, "--protocol", "strict", "--protocol", "flashavatar")
    assert read_results(run)["shown"] == "strict" and len(plotted[1][0]) == 3


def test_the_table_fits_a_terminal_and_has_no_column_that_nobody_measured(run: Path) -> None:
    output = avatar("eval", run)
    figures = [line for line in output.splitlines() if re.search(r"\d\.\d", line) and "/" not in line]
    assert len(figures) > 15 and max(map(len, figures)) <= 80
    assert output.count("LPIPS") == 1, "there are no weights: one line says so, and no column is empty"
    (said,) = [line for line in output.splitlines() if "LPIPS" in line]
    assert len(said) < 100 and "avatar models" in said
    assert output.splitlines()[-1] == f"Next     avatar report {run}"


def test_measuring_again_replaces_the_own_result(run: Path) -> None:
    avatar("eval", run, "--protocol", "strict")
    assert list(read_results(run)["protocols"]) == ["flashavatar", "strict"]
    assert not (run / "eval" / "strict" / "renders").exists(), "pictures of the evaluation before"


def test_a_second_evaluation_waits_and_takes_no_picture_away(run: Path) -> None:
    before = sorted(path for path in (run / "eval").rglob("*"))
    with locked(run / "eval"):
        said = avatar("eval", run, "--protocol", "strict", status=1)
    assert f"{run / 'eval'} is being written by process" in said
    assert sorted(path for path in (run / "eval").rglob("*")) == before


def test_a_lock_that_is_a_link_does_not_write_elsewhere(run: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (run / "eval" / ".lock").symlink_to(tmp_path / "mine")
    assert "eval cannot be written" in avatar("eval", run, "--protocol", "strict", status=1)
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_place_that_cannot_be_written_is_named_with_what_to_do(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        said = avatar("eval", run, "--protocol", "strict", status=1)
    assert f"{run / 'eval'} cannot be written (Read-only file system); free some space" in said and "Errno" not in said
    shutil.rmtree(run / "eval")
    (run / "eval").write_text("a file")
    assert "eval cannot be written (File exists)" in avatar("eval", run, "--protocol", "strict", status=1)


def change(key: str, value: object) -> Callable[[Path], None]:
    def apply(run: Path) -> None:
        results = read_results(run)
        results[key] = value
        (run / "eval" / "results.json").write_text(json.dumps(results))

    return apply


def damage(run: Path) -> None:
    (run / "eval" / "results.json").write_text('{"format": 2, "protocols": [')


STALE = {
    "another step": change("step", 4),
    "other data": change("data_hash", "0" * 64),
    "another size": change("image_size", [40, 40]),
    "another head model": change("head_fingerprint", "0" * 64),
    "another configuration": change("config", {}),
    "another program": change("versions", {"torch": "1.0", "threads": "1"}),
    "another format": change("format", 1),
    "protocols that are none": change("protocols", {"flashavatar": [1]}),
    "results that are damaged": damage,
    "no results": lambda run: (run / "eval" / "results.json").unlink(),
}


@pytest.mark.slow
@pytest.mark.parametrize("reason", STALE)
def test_results_that_are_not_true_any_more_go_with_their_files(run: Path, reason: str) -> None:
    STALE[reason](run)
    (run / "eval" / "flashavatar" / "notes.txt").write_text("mine")
    output = avatar("eval", run, "--protocol", "strict")
    assert list(read_results(run)["protocols"]) == ["strict"] and tables(run) == {"strict"}
    assert [path.name for path in (run / "eval" / "flashavatar").iterdir()] == ["notes.txt"], "what is not ours stays"
    assert "Removed  flashavatar: measured before" in output and "Kept" not in output


def test_a_table_that_does_not_belong_to_the_results_goes(run: Path) -> None:
    table = run / "eval" / "flashavatar" / "frames.csv"
    table.write_text(table.read_text().replace("0", "1"))
    assert "Removed  flashavatar" in avatar("eval", run, "--protocol", "strict")
    assert not table.parent.exists()


def test_another_number_of_threads_is_the_same_evaluation(run: Path) -> None:
    change("versions", {**read_results(run)["versions"], "threads": "99"})(run)
    assert "Kept     flashavatar" in avatar("eval", run, "--protocol", "strict")
