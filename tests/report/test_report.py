"""The page of `avatar report`, as a file and in a browser."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from access import audited
from browsers import chromium
from small_runs import train_small
from tracked_folder import write_tracked_folder

from avatar.cli import main
from avatar.errors import UserError
from avatar.pipeline.open_inputs import open_run
from avatar.report.page import _curves, _figures, _origin, bins_tables, means_table, render_report
from avatar.report.pictures import frame_panels
from avatar.runs.training_curves import read_curves
from avatar.sweep.results import fold_results
from avatar.sweep.spec import Job, Resources, Spec
from avatar.tensors import to_8_bit

LOADED = "[[...document.images].filter((one) => one.naturalWidth > 0).length, document.images.length]"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_tracked_folder(tmp_path_factory.mktemp("report") / "someone", frames=30, size=48)
    train_small(folder, folder.parent / "run", ["model.uv_detail=1"])
    assert main(["eval", str(folder.parent / "run"), "--protocol", "hypergaussians"]) == 0
    (folder.parent / "avatar.html").touch()
    assert main(["report", str(folder.parent / "run")]) == 0
    return folder.parent / "run"


def test_the_page_holds_figures_frames_curves_and_origin_and_loads_nothing(run: Path) -> None:
    page = (run / "report.html").read_text(encoding="utf-8")
    results = json.loads((run / "eval" / "results.json").read_text())
    means = results["protocols"]["hypergaussians"]["means"]
    assert f"{means['psnr']:.2f}" in page and f"{means['ssim']:.4f}" in page
    first = page[page.index("<section>") : page.index("</section>")]
    assert "Held-out frames" in first and f"<dd>{means['ssim_head']:.4f} <span" in first, "the main figures are on top"
    assert 'class="badge error">poor</span></dd>' in first and "PSNR at least 27 good, 23 fair; SSIM at" in first
    sources = re.findall(r'src="([^"]{0,30})', page)
    assert len(sources) == 6 + 2 + 2  # held-out frames; curves and worst of the evaluation; training
    assert all(source.startswith(("data:image/png;base64,", "data:image/jpeg;base64,")) for source in sources)
    assert means_table(results["protocols"]) in page and page.count("<details><summary>The ") == 2
    assert f"<header><h1>Run {run.parent.name}</h1>" in page and "<dd>someone</dd>" in page
    assert str(run.parent.parent) not in page, "where this machine keeps its files concerns nobody else"
    assert results["data_hash"] in page and "trainer.learning_rates.scale" in page
    assert 'id="frame" min="0" max="5" value="0"' in page
    assert len(page) < 8e6


def test_the_avatars_page_beside_a_run_is_linked(run: Path, tmp_path: Path) -> None:
    link = '<a href="../avatar.html">The avatar in its page</a>'
    assert link in (run / "report.html").read_text(encoding="utf-8")
    alone = shutil.copytree(run, tmp_path / "run")
    assert link not in render_report(open_run(alone))


def test_the_truth_is_on_the_left(run: Path) -> None:
    opened = open_run(run)
    name, image = frame_panels(opened)[0]
    frame = opened.subject.frame(opened.subject.split.test[0], opened.config.data.size)
    truth = to_8_bit(frame.composite(torch.tensor(opened.config.data.background))).numpy()
    assert name == frame.name and np.array_equal(image[-len(truth) :, : truth.shape[1]], truth)
    assert image[-len(truth) :, truth.shape[1] : 2 * truth.shape[1]].std() > 5, "and a picture beside it"


def test_curves_are_those_that_training_recorded(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps, psnr, total, *terms = read_curves(run).T
    assert steps.tolist() == [2, 4, 6, 8, 10, 12] and (total > 0).all() and (psnr > 0).all()
    np.testing.assert_allclose(sum(terms), total, rtol=1e-5)
    figures = list[Any]()
    monkeypatch.setattr("avatar.report.page.plot", lambda figure, *_: figures.append(figure))
    _curves(run)
    drawn = [(axes.get_yscale(), *axes.lines[0].get_data()) for axes in (figure.axes[0] for figure in figures)]
    for (scale, x, y), (expected, values) in zip(drawn, (("log", total), ("linear", psnr)), strict=True):
        assert scale == expected and x.tolist() == steps.tolist() and y.tolist() == values.tolist()
    assert len(read_curves(run / "nowhere")) == 0
    for damaged in (b"", b"step,psnr,total\n1,2,3\n", b"step\n1,2,3,4,5,x\n", b"\xff"):
        (tmp_path / "curves.csv").write_bytes(damaged)
        assert len(read_curves(tmp_path)) == 0


def test_protocols_without_a_figure_have_a_dash() -> None:
    protocols = {"a": {"means": {"psnr": 30.126, "lpips": None}, "frames": [1, 2]}, "b": {"means": {"ssim_head": 0.91}}}
    table = means_table({name: {**entry, "driven_by": "tracked"} for name, entry in protocols.items()})
    assert "<td>30.13</td><td>-</td>" in table and "<td>-</td><td>0.9100</td>" in table
    assert "<th>ssim head</th>" in table and "lpips" not in table, "nobody measured it"


def test_a_round_of_refinement_is_named_without_the_machines_folders(run: Path) -> None:
    opened = open_run(run)
    results = json.loads((run / "eval" / "results.json").read_text())
    assert "Measured at step" not in "".join(_figures(opened, results))
    assert "Measured at step 7, while the newest" in "".join(_figures(opened, results | {"step": 7}))
    assert "<p>a note</p>" in "".join(_origin(opened, results | {"notes": ["a note"]}))
    one = {"run": "/home/me/films/me/run/rounds/1/run", "step": 9}
    one |= {"frames_trained_on": 3, "measured_frames_trained_on": 0}
    results["tracking"] |= {"refined": "through the avatar of another run", "rounds": [one]}
    assert "through the avatar of me/run/rounds/1/run (step 9)" in "".join(_figures(opened, results))


def test_bins_name_their_edges_and_their_frames(run: Path) -> None:
    bins = [
        {"from": None, "to": -10.0, "frames": 3, "means": {"psnr": 28.004}},
        {"from": -10.0, "to": 10.0, "frames": 5, "means": {"psnr": None}},
        {"from": 10.0, "to": None, "frames": 1, "means": {"psnr": 27.5}},
    ]
    by_yaw, by_distance = bins_tables(
        {
            "a": {
                "driven_by": "tracked",
                "means": {"psnr": 28.0, "lpips": None},
                "by_yaw": bins,
                "by_expression_distance": bins[:1],
            }
        }
    )
    rows = re.findall(r"<tr>(.*?)</tr>", by_yaw)
    assert [re.sub("<[^>]*>", "|", row).split("||") for row in rows] == [
        ["|degrees of yaw", "frames", "psnr|"],
        ["|below -10", "3", "28.00|"],
        ["|-10 to 10", "5", "-|"],
        ["|10 or more", "1", "27.50|"],
    ]
    assert "below -10.00" in by_distance and "lpips" not in by_distance
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "hypergaussians, by yaw" in page and "hypergaussians, by distance from the training expressions" in page


def test_a_run_that_was_not_evaluated_says_so(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    shutil.rmtree(copy / "eval")
    monkeypatch.chdir(copy)
    assert main(["report", "."]) == 0
    assert "<h1>Run copy</h1>" in (copy / "report.html").read_text(encoding="utf-8")
    assert main(["report", str(copy)]) == 0
    assert "Not measured yet: avatar eval" in (copy / "report.html").read_text(encoding="utf-8")
    (copy / "eval").mkdir()
    (copy / "eval" / "results.json").write_text("[]")
    assert main(["report", str(copy)]) == 1
    assert "was written by another version of this program" in capsys.readouterr().err


def places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inner:
        yield (*path, key)
        yield from places(one, (*path, key))


@pytest.mark.slow
def test_damaged_results_get_a_sentence(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("avatar.report.page.frame_panels", lambda run: [])
    monkeypatch.setattr("avatar.report.page._curves", lambda run: [])
    results = tmp_path / "jobs" / "j" / "run" / "eval" / "results.json"
    results.parent.mkdir(parents=True)
    text = (run / "eval" / "results.json").read_text()
    spec = Spec((Job("j", "s", "v", 0, {"folder": "/f"}, (), ()),), Resources(), 0)
    opened = replace(open_run(run), path=results.parents[1])
    refused = 0
    for path in places(json.loads(text)):
        for wrong in (None, "x", []):
            damaged = json.loads(text)
            reduce(lambda part, key: part[key], path[:-1], damaged)[path[-1]] = wrong
            results.write_text(json.dumps(damaged))
            for read in (lambda: render_report(opened), lambda: fold_results(tmp_path, spec)):
                try:
                    read()
                except UserError as error:
                    assert str(results) in str(error) or str(tmp_path) in str(error)
                    refused += 1
                except Exception as error:
                    pytest.fail(f"{path} = {wrong!r}: {type(error).__name__}: {error}")
    assert refused > 100


@pytest.mark.chromium
def test_in_a_browser_the_arrow_keys_show_frames_and_axe_finds_nothing(run: Path) -> None:
    with chromium() as browser:
        page, wrong = browser.new_page(), []
        page.on("console", lambda said: wrong.append(said.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto((run / "report.html").as_uri())
        assert page.evaluate(LOADED) == [10, 10]
        page.locator("#frame").focus()
        for _ in range(3):
            page.keyboard.press("ArrowRight")
        shown = page.locator("#frames figure:visible")
        assert shown.all_inner_texts() == ["frame 00028"]
        assert page.locator("#frame").get_attribute("aria-valuetext") == "frame 00028"
        assert audited(page) == []
    assert not wrong
