"""Evaluation of a run, end to end on a small subject: what is written and said, and what survives a failure."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from disc import SIZE, TEST, BlobRenderer, make_run, read_png

from avatar.data.split import Split
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.evaluation import measure as measure_module
from avatar.evaluation.evaluate import evaluate, notes_of
from avatar.evaluation.held_out import View
from avatar.evaluation.protocol import builtin_protocols, choose_protocols


def test_protocols_measure_what_they_share_once(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five protocols over three backgrounds: three renderings and, with one masked pair, four SSIM maps a frame."""
    calls: list[str] = []
    for module, name in ((BlobRenderer, "draw"), (measure_module, "ssim_map")):
        real = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, real=real, name=name: (calls.append(name), real(*a))[1])
    evaluate(make_run(tmp_path / "run", subject), say=lambda _: None)
    worst = 3  # drawn again for the contact sheet
    assert (calls.count("draw"), calls.count("ssim_map")) == (3 * len(TEST) + worst, 4 * len(TEST))


def test_bins_intervals_and_worst_frames_are_in_the_results(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    said: list[str] = []
    results = json.loads(evaluate(run, say=said.append).read_text())
    entry = results["protocols"]["hypergaussians"]
    rows = list(csv.DictReader((run.path / "eval" / "hypergaussians" / "frames.csv").open()))
    assert not {"by_held_out", "by_camera"} & entry.keys() and not set(View._fields) & rows[0].keys()  # of one camera
    low, high = entry["intervals"]["psnr"]
    figures = [float(row["psnr"]) for row in rows]
    assert min(figures) - 1e-6 <= low < entry["means"]["psnr"] < high <= max(figures) + 1e-6
    assert entry["bootstrap"] == {
        "method": "moving-block bootstrap over frames, percentile interval of the mean",
        "level": 0.95,
        "block_frames": 1,  # a second would have 20 frames, and there are 3
        "resamples": 2000,
        "seed": 0,
    }
    assert [float(row["yaw"]) for row in rows] == [180.0] * 3  # the test's camera stands behind the head
    (part,) = entry["by_yaw"]
    assert (part["from"], part["to"], part["frames"]) == (30.0, None, 3)
    assert part["means"] == entry["means"]
    assert sum(part["frames"] for part in entry["by_expression_distance"]) == 3
    order = sorted(rows, key=lambda row: float(row["psnr"]))
    assert [part["name"] for part in entry["worst"]] == [row["name"] for row in order]
    assert results["image_size"] == [SIZE, SIZE]
    assert f"{low:.2f} - {high:.2f}" in said[0] and f"worst frames, main PSNR        {order[0]['name']}" in said[0]
    sheet = read_png(run.path / "eval" / "worst.png")
    assert sheet.shape[1] == 2 * 3 * SIZE  # two columns of truth, render and error
    assert sheet.shape[0] % 2 == 0 and (sheet[-1, -1] == 255).all()  # three panels: the last place is empty
    assert read_png(run.path / "eval" / "curves.png").std() > 10


def test_a_protocol_of_ones_own_is_measured_as_it_says(tmp_path: Path, subject: Subject) -> None:
    """Grey background, truncated levels, figures of the head alone."""
    path = tmp_path / "mine.yaml"
    text = builtin_protocols()["strict"].read_text()
    changes = (
        ("background: white", "background: [0.5, 0.5, 0.5]"),
        ("mask: none", "mask: only"),
        ("levels: round", "levels: truncate"),
    )
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    path.write_text(text)
    run = make_run(tmp_path / "run", subject)
    results = json.loads(evaluate(run, [str(path)], write_frames=True, say=lambda _: None).read_text())
    means = results["protocols"]["mine"]["means"]
    assert means["psnr"] == means["psnr_head"] and means["ssim"] == means["ssim_head"]
    truth = read_png(run.path / "eval" / "mine" / "gt" / "00009.png")
    assert (truth[0, 0] == 127).all()  # 127.5 cut, not rounded


def test_results_name_every_choice(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    said: list[str] = []
    results = json.loads(evaluate(run, say=said.append).read_text())
    assert results["data_hash"] == "ef" * 32 and results["head_fingerprint"] == "ab" * 32 and results["step"] == 1500
    assert results["config"] == {"data": {"size": None}}
    assert results["versions"]["torch"] == version("torch")
    assert set(results["shared_choices"]) >= {"truth", "render", "regions", "psnr", "ssim", "lpips", "means"}
    for protocol in choose_protocols(None):
        entry = results["protocols"][protocol.name]
        assert {"background", "mask", "levels", "regions", "lpips_scale", "source"} < set(entry["choices"])
        assert entry["choices"] == json.loads(json.dumps(protocol.choices()))
        assert entry["frames"] == ["00008", "00009", "00010"]
        assert entry["frames_with_a_figure"]["psnr_mouth"] == 2
        assert set(entry["means"]) == set(protocol.columns)
        # no weights on this machine: said, and no figure made up
        assert entry["means"]["lpips"] is None and entry["lpips"]["network"] is None
        assert entry["lpips"]["note"].startswith("not measured") and len(entry["lpips"]["note"]) < 100
        assert not (run.path / "eval" / protocol.name / "renders").exists()
    run.config.trainer.opposite_background_every = 3
    (alone,) = [note for note in notes_of(choose_protocols(None), run) if "drawn over" in note]
    assert alone.startswith("flashavatar")
    green, black = results["notes"]
    assert green.startswith("flashavatar: drawn over green, trained over white; ")
    assert black.startswith("rgbavatar: drawn over black, trained over white; ")
    table, places = said
    assert f"Note: {green}" in table and f"Note: {black}" in table
    assert str(run.path / "eval" / "results.json") in places and "truth_render_error.mp4" in places
    assert table.count("not measured") == 1
    for name in builtin_protocols():
        assert f"\n{name}" in table and f"{results['protocols'][name]['means']['psnr']:.2f}" in table


@pytest.mark.parametrize(
    ("background", "noted"),
    [
        ((0.5, 0.5, 0.5), ["flashavatar", "hypergaussians and strict"]),
        ((0.7, 0.2, 0.9), ["hypergaussians and strict", "rgbavatar"]),
    ],
)
def test_the_opposite_of_any_background_was_trained_over(
    background: tuple[float, ...], noted: list[str], tmp_path: Path, subject: Subject
) -> None:
    """As training has it: 0 or 1 in each channel. The opposite of grey is black."""
    run = make_run(tmp_path / "run", subject)
    run.config.data.background, run.config.trainer.opposite_background_every = background, 3
    protocols = choose_protocols(["hypergaussians", "flashavatar", "rgbavatar", "strict"])
    assert sorted(note.partition(":")[0] for note in notes_of(protocols, run) if "drawn over" in note) == noted


def test_video_shows_every_frame(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    evaluate(run, ["hypergaussians"], say=lambda _: None)
    reader = imageio.get_reader(run.path / "eval" / "truth_render_error.mp4")
    assert reader.get_meta_data()["fps"] == 20.0
    frames = [np.asarray(frame) for frame in reader]
    assert len(frames) == len(TEST) and frames[0].shape[1] == 3 * 720 and frames[0].shape[0] > 720


def test_pictures_of_an_earlier_evaluation_do_not_stay(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    stale = run.path / "eval" / "insta350" / "renders" / "00001.png"
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"old")
    evaluate(run, ["insta350"], write_frames=True, say=lambda _: None)
    assert sorted(path.name for path in stale.parent.iterdir()) == ["00007.png", "00008.png", "00009.png"]


@pytest.mark.slow
@pytest.mark.parametrize("what", ["step", "data", "head model"])
def test_figures_of_something_else_do_not_stay(tmp_path: Path, subject: Subject, what: str) -> None:
    """Beside those by another protocol, of the avatar as it is now."""
    run = make_run(tmp_path / "run", subject)
    said: list[str] = []

    def measured(protocol: str) -> list[str]:
        return sorted(json.loads(evaluate(run, [protocol], say=said.append).read_text())["protocols"])

    assert measured("insta350") == ["insta350"] and measured("strict") == ["insta350", "strict"]
    if what == "step":
        run.step += 100
    elif what == "data":
        run.subject = replace(subject, recording=replace(subject.recording, data_hash="0" * 64))
    else:
        run.avatar.head.assets.fingerprint = "0" * 64
    assert measured("flashavatar") == ["flashavatar"]
    assert "Removed" in said[-1] and not (run.path / "eval" / "strict").exists()


def test_a_failure_on_the_way_keeps_the_old_results(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    path = evaluate(run, ["insta350"], say=lambda _: None)
    before = path.read_bytes()
    (Path(subject.manifest.source) / "00009_image.png").write_bytes(b"not a picture")
    with pytest.raises(UserError, match=r"00009_image\.png"):
        evaluate(run, ["insta350"], say=lambda _: None)
    assert path.read_bytes() == before
    with pytest.raises(UserError, match="there is no protocol 'mine'"):
        evaluate(run, ["mine"], say=lambda _: None)


def test_a_protocol_without_a_frame_is_left_out_before_rendering(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames at the beginning are held out, and two protocols measure the end: the others have their figures."""
    path = tmp_path / "last2.yaml"
    path.write_text(builtin_protocols()["insta350"].read_text().replace("frames: 350", "frames: 2"))
    early = replace(subject, recording=replace(subject.recording, split=Split(tuple(range(3, 10)), (0, 1, 2))))
    run = make_run(tmp_path / "run", early)
    said: list[str] = []
    real = BlobRenderer.draw
    monkeypatch.setattr(BlobRenderer, "draw", lambda *a: (said.append("drawn"), real(*a))[1])
    results = json.loads(evaluate(run, [str(path), "strict"], say=said.append).read_text())
    sentence = "last2 is not measured: none of the last 2 frames of disc is held out"
    assert said[:2] == [f"Note: {sentence}", "drawn"]
    assert list(results["protocols"]) == ["strict"] and results["protocols"]["strict"]["frames"][0] == "00001"
    assert results["left_out"] == {"last2": sentence} and sentence in results["notes"]
    assert f"Note: {sentence}" in said[-2]  # under the table too
    said.clear()
    with pytest.raises(UserError, match=f"there is nothing to measure: {sentence}; choose a protocol of other frames"):
        evaluate(run, [str(path)], say=said.append)
    assert said == []
