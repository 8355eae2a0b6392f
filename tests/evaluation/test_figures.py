"""The figures of an evaluation are those of the pictures that it writes."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from disc import EYES, NECK, SIZE, TEST, Blob, BlobRenderer, make_run, read_png

from avatar.data.frame import Frame
from avatar.data.subject import Subject
from avatar.evaluation.evaluate import evaluate
from avatar.evaluation.protocol import MEASURES, RIMS, choose_protocols
from avatar.evaluation.regions import outline_rims
from avatar.evaluation.verify import recompute
from avatar.losses.lpips import lpips_folder, save_lpips
from avatar.losses.lpips_network import Lpips
from avatar.types import Rendering


def test_every_figure_can_be_recomputed_from_the_pictures(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    said: list[str] = []
    results = json.loads(evaluate(run, write_frames=True, say=said.append).read_text())
    assert run.avatar.seen[:3] == pytest.approx([7 / 9, 8 / 9, 1.0])  # the held-out frames, each once for all protocols
    for protocol in choose_protocols(None):
        name = protocol.name
        folder = run.path / "eval" / name
        rows = list(csv.DictReader((folder / "frames.csv").open()))
        assert [(row["frame"], row["name"]) for row in rows] == [("7", "00008"), ("8", "00009"), ("9", "00010")]
        for row in rows:
            seen = recompute(folder, int(row["frame"]), results["protocols"][name]["choices"])
            assert set(seen) == {c for c in protocol.columns if c.startswith(("psnr", "ssim"))}
            for figure, value in seen.items():
                assert float(row[figure]) == pytest.approx(value, abs=1e-6, nan_ok=True), (name, row["name"], figure)
            assert (row["psnr_mouth"] == "nan") == (row["name"] == "00009")  # its mouth is hidden
        means = results["protocols"][name]["means"]
        assert means["psnr"] == pytest.approx(np.mean([float(row["psnr"]) for row in rows]), abs=1e-6)
        mouth_rows = [float(row["ssim_mouth"]) for row in rows if row["ssim_mouth"] != "nan"]
        assert means["ssim_mouth"] == pytest.approx(np.mean(mouth_rows), abs=1e-6) and len(mouth_rows) == 2


def test_regions_divide_the_head(tmp_path: Path, subject: Subject) -> None:
    """Eyes, rest and mouth of the strict protocol: the boxes about the projected eyeballs, the head without them."""
    run = make_run(tmp_path / "run", subject)
    evaluate(run, ["strict"], write_frames=True, say=lambda _: None)
    folder = run.path / "eval" / "strict"
    rows = {row["name"]: row for row in csv.DictReader((folder / "frames.csv").open())}
    for name, row in rows.items():
        file = f"{int(row['frame']):05d}.png"
        kinds = ("masks", "mouth_masks", "eyes_masks", "rest_masks")
        head, mouth, eyes, rest = (read_png(folder / kind / file).astype(float) for kind in kinds)
        columns, lines = np.arange(SIZE) + 0.5, np.arange(SIZE)[:, None] + 0.5
        left, right = (abs(columns - middle) <= 6 * 1.5 for middle in (24, 48))  # a quarter of 12 more on either side
        box = (left | right) & (abs(lines - 28) <= 4 * 1.5)
        assert (eyes == head * box * (mouth == 0)).all() and (rest == head * ~box * (mouth == 0)).all()
        seen = recompute(folder, int(row["frame"]), {"mask": "none", "regions": ["eyes", "rest"]})
        assert seen["psnr_eyes"] != pytest.approx(seen["psnr_rest"], abs=0.1)
        for figure, value in seen.items():
            assert float(row[figure]) == pytest.approx(value, abs=1e-6), (name, figure)


def test_rims_lie_along_the_outline(tmp_path: Path, subject: Subject) -> None:
    """Within 8/256 of the picture's side of the outline of matte x head mask; the neck's where its vertex is nearest."""
    run = make_run(tmp_path / "run", subject)
    results = json.loads(evaluate(run, ["strict"], write_frames=True, say=lambda _: None).read_text())
    masks = {kind: read_png(run.path / "eval/strict" / f"{kind}_masks" / "00008.png") for kind in RIMS}
    assert all(set(np.unique(mask)) == {0, 255} for mask in masks.values())
    assert not ((masks["head_rim"] > 0) & (masks["neck_rim"] > 0)).any()
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    outline = 26 - 0.5 * 255 / 80  # where the disc's head mask is half
    away = abs(np.hypot(x - SIZE / 2, y - SIZE / 2) - outline)
    either, reach = (masks["head_rim"] > 0) | (masks["neck_rim"] > 0), SIZE * 8 / 256
    assert either[away < reach - 1.5].all() and not either[away > reach + 1.0].any()
    corners = torch.cat((EYES, NECK))[:, :2].numpy() * SIZE + SIZE / 2
    distance = np.hypot(x[..., None] + 0.5 - corners[:, 0], y[..., None] + 0.5 - corners[:, 1])
    below = distance[..., 4] < distance[..., :4].min(axis=-1)
    assert ((masks["neck_rim"] > 0) == either & below).all() and below[either].any()
    means = results["protocols"]["strict"]["means"]
    assert "lpips_head_rim" not in means and means["psnr_head_rim"] != means["psnr_neck_rim"]


def test_a_picture_that_is_all_head_has_no_rim() -> None:
    """The picture's border is no outline."""
    rims = outline_rims(torch.ones(20, 30), torch.zeros(1, 2), torch.tensor([True]))
    assert not any(rim.any() for rim in rims)


def test_a_head_model_without_eyeballs_has_no_figure_for_eyes(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    run.avatar = Blob(eyeballs=False)
    results = json.loads(evaluate(run, ["strict"], say=lambda _: None).read_text())
    entry = results["protocols"]["strict"]
    assert all(entry["means"][f"{measure}_{region}"] is None for measure in MEASURES for region in ("eyes", "rest"))
    assert entry["means"]["psnr_head"] > 0
    assert "strict: eyes and rest not measured, because the head model names no left_eyeball" in results["notes"][0]


def test_jitter_can_be_recomputed_from_the_pictures(tmp_path: Path, subject: Subject) -> None:
    """Three frames have one second difference, which belongs to the middle one."""
    run = make_run(tmp_path / "run", subject)
    results = json.loads(evaluate(run, ["flashavatar"], write_frames=True, say=lambda _: None).read_text())
    folder = run.path / "eval" / "flashavatar"

    def stack(kind: str) -> np.ndarray:
        return np.stack([read_png(folder / kind / f"{index:05d}.png").astype(float) for index in TEST])

    error, masks = stack("renders") - stack("gt"), stack("masks")
    change = np.abs(error[0] - 2 * error[1] + error[2]).mean(axis=2)
    expected = np.average(change, weights=masks.min(axis=0))
    rows = list(csv.DictReader((folder / "frames.csv").open()))
    assert [row["jitter"] for row in rows] == ["nan", f"{expected:.6f}", "nan"]
    entry = results["protocols"]["flashavatar"]
    assert entry["means"]["jitter"] == pytest.approx(expected, rel=1e-9) and expected > 0.1
    assert entry["frames_with_a_figure"]["jitter"] == 1


def test_jitter_goes_by_the_frames_numbers(tmp_path: Path, subject: Subject) -> None:
    """Where the first frames of the video were left out, numbers and positions differ; a gap in them has no jitter."""

    def jitter(name: str, numbers: list[int]) -> list[str]:
        records = zip(subject.manifest.frames, numbers, strict=True)
        frames = tuple(replace(record, tracking=number) for record, number in records)
        numbered = replace(subject, manifest=replace(subject.manifest, frames=frames))
        run = make_run(tmp_path / name, numbered)
        evaluate(run, ["flashavatar"], say=lambda _: None)
        rows = csv.DictReader((run.path / "eval" / "flashavatar" / "frames.csv").open())
        return [row["jitter"] for row in rows]

    plain = jitter("plain", [*range(10)])
    assert plain[1] != "nan" and jitter("later", [*range(100, 110)]) == plain
    assert jitter("gap", [*range(9), 20]) == ["nan"] * 3


def test_an_avatar_without_error_has_no_worst_frame(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Infinite PSNR is no figure: results stay valid JSON, and there is nothing to look at."""
    monkeypatch.setattr(
        BlobRenderer,
        "draw",
        lambda self, gaussians, camera, colour: Rendering(colour.expand(SIZE, SIZE, 3), torch.ones(SIZE, SIZE)),
    )
    monkeypatch.setattr(Frame, "composite", lambda self, colour: colour.expand(SIZE, SIZE, 3))
    run = make_run(tmp_path / "run", subject)
    said: list[str] = []
    entry = json.loads(evaluate(run, ["strict"], say=said.append).read_text())["protocols"]["strict"]
    assert entry["means"]["psnr"] is None and entry["means"]["ssim"] == 1.0 and entry["means"]["jitter"] == 0.0
    assert entry["worst"] == [] and entry["intervals"]["psnr"] is None and entry["intervals"]["ssim"] == [1.0, 1.0]
    assert not (run.path / "eval" / "worst.png").exists() and "worst.png" not in said[1]


def test_lpips_of_another_network_is_labelled(tmp_path: Path, subject: Subject) -> None:
    lpips_folder().mkdir(parents=True)
    lpips = Lpips("squeeze")
    save_lpips(lpips, lpips_folder() / "lpips_squeeze.safetensors")
    run = make_run(tmp_path / "run", subject)
    results = json.loads(evaluate(run, ["hypergaussians"], write_frames=True, say=lambda _: None).read_text())
    entry = results["protocols"]["hypergaussians"]
    assert entry["lpips"]["network"] == "squeeze" and entry["lpips"]["weights_sha256"] == lpips.fingerprint()
    assert entry["lpips"]["note"].startswith("squeeze, not to be compared with figures of vgg (no weights")
    figures = []
    for index in TEST:
        kinds = ("renders", "gt", "masks")
        a, b, mask = (
            torch.from_numpy(read_png(run.path / "eval" / "hypergaussians" / kind / f"{index:05d}.png")) / 255.0
            for kind in kinds
        )
        figures.append(lpips(a.flip(-1) * mask[..., None], b.flip(-1) * mask[..., None]).item())
    assert entry["means"]["lpips"] == pytest.approx(np.mean(figures), rel=1e-5)


def test_truth_is_the_composite_of_the_data_over_the_background_of_the_protocol(
    tmp_path: Path, subject: Subject
) -> None:
    run = make_run(tmp_path / "run", subject)
    evaluate(run, ["hypergaussians", "flashavatar"], write_frames=True, say=lambda _: None)
    for name, background in (("hypergaussians", (255, 255, 255)), ("flashavatar", (0, 255, 0))):
        kinds = ("gt", "renders", "masks", "mouth_masks")
        truth, render, head, mouth = (read_png(run.path / "eval" / name / kind / "00009.png") for kind in kinds)
        source = Path(subject.manifest.source)
        image, alpha, mask = (
            read_png(source / f"00010_{kind}.png").astype(float) for kind in ("image", "alpha", "head")
        )
        weight = (alpha * mask)[..., None] / 255.0**2
        expected = image * weight + np.array(background) * (1 - weight)
        assert np.abs(truth - expected).max() <= 0.5 + 1e-3  # rounding to 8 bits, nothing else
        assert (truth[0, 0] == background).all() and (render[0, 0] == background).all()
        assert (head == mask).all() and (mouth == read_png(source / "00010_mouth.png")).all()
