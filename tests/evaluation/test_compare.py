"""Comparison of evaluated runs, on results that are written here."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar.errors import UserError
from avatar.evaluation.compare import compare_runs
from avatar.evaluation.compare_tables import as_csv, latex, markdown, text, write_tables

FRAMES = [f"{number:05d}" for number in range(40)]


def write_run(
    run: Path, figures: dict[str, Any], frames: list[str] = FRAMES, protocol: str = "strict", **changes: Any
) -> Path:
    """An evaluated run; `figures` has values for each frame, `changes` replace top-level entries of results.json."""
    rows = io.StringIO()
    writer = csv.writer(rows, lineterminator="\n")
    writer.writerow(("frame", "name", *figures, "yaw"))
    for number, name in enumerate(frames):
        writer.writerow((number, name, *(f"{values[number]:.6f}" for values in figures.values()), "0.0"))
    data = rows.getvalue().encode()
    (run / "eval" / protocol).mkdir(parents=True)
    (run / "eval" / protocol / "frames.csv").write_bytes(data)
    entry = {
        "choices": {"summary": str(run), "background": [1.0, 1.0, 1.0], "levels": changes.pop("levels", "round")},
        "lpips": {"weights_sha256": changes.pop("network", None)},
        "means": dict.fromkeys(figures, 1.0),
        "bootstrap": {"block_frames": 10},
        "frames_sha256": hashlib.sha256(data).hexdigest(),
        "driven_by": "tracked",
    }
    results = {"format": 3, "data_hash": "ab" * 32, "head_fingerprint": "cd" * 32, "image_size": [64, 64]}
    results |= {"perceptual": "dssim", "tracking": {"tracker": "insta", "rounds": []}}
    results |= {"protocols": {protocol: entry}} | changes
    (run / "eval" / "results.json").write_text(json.dumps(results))
    return run


def smooth(seed: int) -> np.ndarray:
    """Figures that are hard and easy in the same frames for everybody, and a little noise of one's own."""
    hard = 3 * np.sin(np.arange(40) / 6.0)
    return 28 + hard + 0.1 * np.random.default_rng(seed).normal(size=40)


def test_paired_differences_are_clear_where_the_means_overlap(tmp_path: Path) -> None:
    """A quarter of a decibel under frames that differ by six."""
    a, b = write_run(tmp_path / "a", {"psnr": smooth(1)}), write_run(tmp_path / "b", {"psnr": smooth(2) + 0.25})
    comparison = compare_runs([a, b])
    (each,) = comparison.protocols
    first, second = each.rows["psnr"]
    assert (each.count, each.unit, each.method) == (40, "frames", "blocks of 10 frames") and comparison.labels == [
        "a",
        "b",
    ]
    assert first.mean == pytest.approx(smooth(1).mean(), abs=1e-6) and first.difference is None
    assert second.difference == pytest.approx(second.mean - first.mean, abs=1e-9)
    assert second.interval is not None
    low, high = second.interval
    assert 0.1 < low < second.difference < high < 0.4 and second.is_clear
    (twin,) = compare_runs([a, write_run(tmp_path / "c", {"psnr": smooth(1)})]).protocols
    assert twin.rows["psnr"][1][1:] == (0.0, (0.0, 0.0)) and not twin.rows["psnr"][1].is_clear


def test_only_frames_that_all_runs_have_count(tmp_path: Path) -> None:
    values = smooth(1)
    a = write_run(tmp_path / "a", {"psnr": values})
    b = write_run(tmp_path / "b", {"psnr": values[10:] + 1.0}, FRAMES[10:])
    c = write_run(tmp_path / "c", {"psnr": values[:30] + 2.0}, FRAMES[:30])
    comparison = compare_runs([a, b, c])
    (each,) = comparison.protocols
    assert each.count == 20 and each.method == "blocks of 5 frames"
    assert [cell.mean for cell in each.rows["psnr"]] == pytest.approx(values[10:30].mean() + np.arange(3), abs=1e-6)
    assert comparison.notes == ["strict: 20 frames are in all runs, 20 more in some; only the common ones count"]
    apart = compare_runs([b, c])
    assert apart.notes == ["strict: 20 frames are in all runs, 20 more in some; only the common ones count"]
    d = write_run(tmp_path / "d", {"psnr": values[:5]}, FRAMES[:5])
    with pytest.raises(
        UserError, match="b and d cannot be compared: strict was measured on frames of which none is in"
    ):
        compare_runs([b, d])


def test_blocks_hold_what_several_cameras_saw_at_once_in_whatever_order_their_frames_come(tmp_path: Path) -> None:
    times = np.repeat(np.arange(20), 2)
    names = [f"{time}_{n % 2}" for n, time in enumerate(times)]
    cells = []
    for way, rows in (("by_time", [*range(40)]), ("by_camera", [*range(0, 40, 2), *range(1, 40, 2)])):
        runs = [
            write_run(
                tmp_path / way / str(seed),
                {"psnr": smooth(seed)[rows], "time": times[rows].astype(float)},
                [names[row] for row in rows],
            )
            for seed in range(2)
        ]
        cells.append(compare_runs(runs).protocols[0].rows["psnr"][1])
    assert cells[0] == cells[1]


def test_frames_without_a_figure_in_one_run_count_in_none(tmp_path: Path) -> None:
    values, holes = smooth(1), smooth(1)
    holes[3], holes[5] = np.nan, np.inf
    never = np.full(40, np.nan)
    a = write_run(tmp_path / "a", {"psnr": values, "lpips": never})
    b = write_run(tmp_path / "b", {"psnr": holes, "lpips": never})
    comparison = compare_runs([a, b])
    (each,) = comparison.protocols
    assert each.rows["psnr"][0].mean == pytest.approx(np.delete(values, (3, 5)).mean(), abs=1e-6)
    assert each.rows["psnr"][1].difference == 0.0
    assert comparison.notes == ["strict: in no frame of all runs is there lpips"] and list(each.rows) == ["psnr"]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"data_hash": "ef" * 32}, "b was evaluated on other data than a (efefefefefef, not abababababab)"),
        ({"head_fingerprint": "ef" * 32}, "b was evaluated on another head model than a"),
        ({"image_size": [128, 64]}, "b was evaluated on another image size than a (128x64, not 64x64)"),
        ({"levels": "truncate"}, "a and b cannot be compared: strict differs between the runs in levels"),
        ({"protocol": "mine"}, "a and b cannot be compared: strict was not measured for b"),
        ({"format": 2}, "results.json was written by another version of this program; evaluate the run again"),
        ({"format": True}, "results.json was written by another version"),
    ],
)
def test_what_cannot_be_compared_is_refused_with_a_sentence(
    changes: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    a = write_run(tmp_path / "a", {"psnr": smooth(1)})
    b = write_run(tmp_path / "b", {"psnr": smooth(2)}, **changes)
    with pytest.raises(UserError) as caught:
        compare_runs([a, b])
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


def test_damaged_and_missing_results_are_named(tmp_path: Path) -> None:
    a, b = (write_run(tmp_path / name, {"psnr": smooth(1)}) for name in "ab")
    with pytest.raises(UserError, match="give at least two runs"):
        compare_runs([a])
    with pytest.raises(UserError, match=r"none was not evaluated .*: run avatar eval .*none first"):
        compare_runs([a, tmp_path / "none"])
    with pytest.raises(UserError, match="insta350 was not measured for a, b"):
        compare_runs([a, b], ["insta350"])
    with (b / "eval" / "strict" / "frames.csv").open("a") as file:
        file.write("0,00000,99.0,0.0\n")
    with pytest.raises(UserError, match=r"frames\.csv is not the file that results\.json was written with"):
        compare_runs([a, b])
    (b / "eval" / "results.json").write_text('{"format": 3}')
    with pytest.raises(
        UserError, match=r"results\.json is damaged \(data_hash, head_fingerprint, image_size, perceptual, "
    ):
        compare_runs([a, b])
    results = json.loads((a / "eval" / "results.json").read_text())
    results["protocols"] = {"../../elsewhere": next(iter(results["protocols"].values()))}
    (b / "eval" / "results.json").write_text(json.dumps(results))
    with pytest.raises(UserError, match="the names of its protocols"):
        compare_runs([a, b])
    whole = json.loads((a / "eval" / "results.json").read_text())
    for path in (("tracking", "rounds"), *(("protocols", "strict", key) for key in whole["protocols"]["strict"])):
        damaged = json.loads(json.dumps(whole))
        del reduce(dict.__getitem__, path[:-1], damaged)[path[-1]]
        (b / "eval" / "results.json").write_text(json.dumps(damaged))
        with pytest.raises(UserError, match=rf"results\.json is damaged \({'.'.join(path)}\): run avatar eval"):
            compare_runs([a, b])
    (b / "eval" / "results.json").write_text("{")
    with pytest.raises(UserError, match=r"results\.json cannot be read"):
        compare_runs([a, b])


def test_figures_that_a_run_lacks_are_left_out_with_a_note(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", {"psnr": smooth(1), "ssim": smooth(2)})
    comparison = compare_runs([a, write_run(tmp_path / "b", {"psnr": smooth(3)})])
    assert list(comparison.protocols[0].rows) == ["psnr"]
    assert comparison.notes == ["strict: ssim was not measured for b"]
    results = json.loads((a / "eval" / "results.json").read_text())
    results["protocols"]["strict"]["means"]["lpips"] = 0.1
    (a / "eval" / "results.json").write_text(json.dumps(results))
    with pytest.raises(UserError, match=r"a/eval/strict/frames\.csv has no column 'lpips'; evaluate the run again"):
        compare_runs([a, a])


def test_a_protocol_that_is_named_twice_is_compared_once(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, {"psnr": smooth(1)}) for name in "ab"]
    assert [each.protocol for each in compare_runs(runs, ["strict", "my/strict.yaml"]).protocols] == ["strict"]


def test_a_run_that_has_gone_on_since_it_was_measured_is_named(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", {"psnr": smooth(1)}, step=12)
    b = write_run(tmp_path / "b", {"psnr": smooth(2)}, step=12)
    for run, steps in ((a, (8, 12)), (b, (12, 16))):
        (run / "checkpoints").mkdir()
        for step in steps:
            (run / "checkpoints" / f"step_{step:08d}.safetensors").touch()
    assert compare_runs([a, b]).notes == ["b was measured at step 12, and its newest checkpoint is of step 16"]


def test_lpips_of_different_networks_is_not_compared(tmp_path: Path) -> None:
    figures = {"psnr": smooth(1), "lpips": smooth(2), "lpips_head": smooth(3)}
    a = write_run(tmp_path / "a", figures, network="11")
    b = write_run(tmp_path / "b", figures, network="22")
    comparison = compare_runs([a, b])
    assert list(comparison.protocols[0].rows) == ["psnr"]
    assert comparison.notes == ["strict: LPIPS is left out, because the runs were measured with different networks"]


def test_tables(tmp_path: Path) -> None:
    a = write_run(
        tmp_path / "a_1", {"psnr": np.full(40, 30.0), "ssim_head": np.full(40, 0.9), "jitter": np.full(40, 2.0)}
    )
    b = write_run(
        tmp_path / "b|2", {"psnr": np.full(40, 31.5), "ssim_head": np.full(40, 0.9), "jitter": np.full(40, 1.5)}
    )
    comparison = compare_runs([a, b])
    caption = "strict (tracked): 40 frames, differences to {} with 95% intervals (blocks of 10 frames)"
    legend = "*: the interval leaves out 0. Higher is better for PSNR and SSIM, lower for LPIPS and jitter."
    lines = text(comparison).splitlines()
    assert [line.split("   ")[0] for line in lines[2:5]] == ["PSNR, dB", "SSIM head", "jitter, levels"]
    assert len({line.index(mean) + 5 for line, mean in zip(lines[2:5], ("30.00", ".9000", " 2.00"), strict=True)}) == 1
    assert [" ".join(line.split()) for line in lines] == [
        caption.format("a_1"),
        "tracked a_1 b|2",
        "PSNR, dB 30.00 31.50 +1.50 [+1.50, +1.50]*",
        "SSIM head 0.9000 0.9000 +0.0000 [+0.0000, +0.0000]",
        "jitter, levels 2.00 1.50 -0.50 [-0.50, -0.50]*",
        "",
        legend,
        "tracked: as insta left it; trackers fit each frame to its own picture, held out or not",
        "Perceptual term in training: dssim",
    ]
    assert markdown(comparison).splitlines()[2:5] == [
        "| tracked | a_1 | b\\|2 |",
        "|---|---|---|",
        "| PSNR, dB | 30.00 | 31.50 +1.50 [+1.50, +1.50]\\* |",
    ]
    lines = latex(comparison).splitlines()
    assert "\\begin{tabular}{lrr}" in lines and "tracked & a\\_1 & b|2 \\\\" in lines
    assert "PSNR, dB $\\uparrow$ & $30.00$ & $31.50$ ($+1.50$ $[+1.50, +1.50]$)* \\\\" in lines
    assert "jitter, levels $\\downarrow$ & $2.00$ & $1.50$ ($-0.50$ $[-0.50, -0.50]$)* \\\\" in lines
    rims = [write_run(tmp_path / name, {"psnr_head_rim": np.full(40, 30.0)}) for name in ("c", "d")]
    assert "PSNR head\\_rim, dB $\\uparrow$" in latex(compare_runs(rims))
    rows = list(csv.DictReader(io.StringIO(as_csv(comparison))))
    line = ["strict", "tracked", "psnr", "b|2", "40", "31.500000", "1.500000", "1.500000", "1.500000", "dssim", ""]
    assert list(rows[1].values()) == line
    assert rows[0]["difference"] == "" and len(rows) == 6
    write_tables(tmp_path / "out", comparison)
    assert (tmp_path / "out" / "compare.md").read_text() == markdown(comparison)
