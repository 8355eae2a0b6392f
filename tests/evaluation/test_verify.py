"""avatar eval --verify: what the pictures say is computed again, and whatever does not agree is named."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from disc import SIZE, make_run, read_png

from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.evaluation import jitter as jitter_module
from avatar.evaluation import measure as measure_module
from avatar.evaluation.evaluate import evaluate
from avatar.evaluation.verify import recompute, verify
from avatar.losses.metrics import ssim

ALL = {"mask": "none", "regions": ["head", "mouth"]}


@pytest.fixture
def results(tmp_path: Path, subject: Subject) -> Path:
    return evaluate(make_run(tmp_path / "run", subject), write_frames=True, say=lambda _: None)


def write_frame(folder: Path, error: int, mask: np.ndarray) -> None:
    """A grey truth, a render that is `error` levels brighter inside the mask, and the mask as head and mouth."""
    truth = np.full((SIZE, SIZE, 3), 100, np.uint8)
    render = truth + (mask > 0)[..., None] * np.uint8(error)
    for kind, picture in (("renders", render), ("gt", truth), ("masks", mask), ("mouth_masks", mask * 0)):
        (folder / kind).mkdir(exist_ok=True)
        assert cv2.imwrite(str(folder / kind / "00003.png"), picture)


@pytest.mark.parametrize("error", [5, 51])
def test_known_errors_have_known_figures(error: int, tmp_path: Path) -> None:
    """51 levels are a fifth of the range: an error of 0.04, 13.98 dB; over a quarter of the frame, 6.02 dB more."""
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[: SIZE // 2, : SIZE // 2] = 255
    write_frame(tmp_path, error, mask)
    inside = -20 * math.log10(error / 255)
    whole = recompute(tmp_path, 3, ALL)
    assert whole["psnr_head"] == pytest.approx(inside)
    assert whole["psnr"] == pytest.approx(inside + 10 * math.log10(4))
    assert math.isnan(whole["psnr_mouth"]) and math.isnan(whole["ssim_mouth"])
    render, truth = (
        torch.from_numpy(read_png(tmp_path / kind / "00003.png")).double() / 255 for kind in ("renders", "gt")
    )
    expected = ssim(render, truth, torch.from_numpy(mask).double() / 255).item()
    assert whole["ssim_head"] == pytest.approx(expected, abs=1e-9) and whole["ssim_head"] < whole["ssim"] < 1
    only = recompute(tmp_path, 3, {"mask": "only", "regions": []})
    assert only == {"psnr": whole["psnr_head"], "ssim": whole["ssim_head"]}
    # the mask takes the truth away outside: what is equal there stays equal
    assert recompute(tmp_path, 3, {"mask": "multiply", "regions": []})["psnr"] == pytest.approx(whole["psnr"])


def test_equal_pictures_are_infinitely_good(tmp_path: Path) -> None:
    write_frame(tmp_path, 0, np.full((SIZE, SIZE), 255, np.uint8))
    figures = recompute(tmp_path, 3, ALL)
    assert figures["psnr"] == figures["psnr_head"] == math.inf and figures["ssim"] == pytest.approx(1)


def test_every_protocol_is_verified_and_that_is_recorded(results: Path) -> None:
    said: list[str] = []
    verify(results, say=said.append)
    protocols = json.loads(results.read_text())["protocols"]
    assert [line.partition(":")[0] for line in said] == list(protocols)
    for line, entry in zip(said, protocols.values(), strict=True):
        assert "PSNR, SSIM and jitter of 3 frames verified" in line
        verified = entry["verified"]
        assert verified["by"].startswith("scikit-image ") and verified["frames"] == 3 and verified["tolerance"] == 2e-6
        assert 0 < verified["largest_difference"] < 1e-6  # frames.csv is rounded to six decimals
        assert f"largest difference {verified['largest_difference']:.1e}" in line


def test_only_the_protocols_that_are_asked_for_are_verified(results: Path) -> None:
    said: list[str] = []
    verify(results, ["strict"], said.append)
    protocols = json.loads(results.read_text())["protocols"]
    assert [name for name, entry in protocols.items() if "verified" in entry] == ["strict"] and len(said) == 1


def brighter(folder: Path) -> None:
    """One channel of one pixel inside the head."""
    path = folder / "renders" / "00008.png"
    image = read_png(path)
    image[36, 36, 1] = image[36, 36, 1] ^ 64
    assert cv2.imwrite(str(path), image)


def edit_table(figure: str, by: float) -> Callable[[Path], None]:
    """Change a figure of frame 00009 in frames.csv, and the hash that would show it."""

    def edit(folder: Path) -> None:
        rows = list(csv.DictReader((folder / "frames.csv").open()))
        rows[1][figure] = f"{float(rows[1][figure]) + by:.6f}"
        text = io.StringIO()
        writer = csv.DictWriter(text, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        (folder / "frames.csv").write_text(text.getvalue())
        edit_entry(folder, frames_sha256=hashlib.sha256(text.getvalue().encode()).hexdigest())

    return edit


def edit_entry(folder: Path, **values: object) -> None:
    path = folder.parent / "results.json"
    summary = json.loads(path.read_text())
    summary["protocols"][folder.name] |= values
    path.write_text(json.dumps(summary))


def better_mean(folder: Path) -> None:
    path = folder.parent / "results.json"
    means = json.loads(path.read_text())["protocols"][folder.name]["means"]
    edit_entry(folder, means=means | {"ssim_head": means["ssim_head"] + 3e-6})


DISAGREEMENTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "a pixel of a picture": (
        brighter,
        r"psnr of frame 00009 is [0-9.]+ in .*strict/frames\.csv, but its pictures give",
    ),
    "a figure of the table": (
        edit_table("ssim_rest", -3e-6),
        r"ssim_rest of frame 00009 is .* \([23]\.\de-06 apart, 2e-06 allowed",
    ),
    "the jitter between frames": (
        edit_table("jitter", 3e-6),
        r"jitter of frame 00009 is .* \([23]\.\de-06 apart, 2e-06 allowed",
    ),
    "a mean": (better_mean, r"ssim_head of the mean is .*results\.json"),
    "a table that was exchanged": (
        lambda f: (f / "frames.csv").write_text((f / "frames.csv").read_text() + " "),
        r"strict/frames\.csv is not the table that results\.json was made from",
    ),
    "a picture that is gone": (lambda f: (f / "gt" / "00009.png").unlink(), r"gt/00009\.png does not exist"),
    "a picture cut short": (
        lambda f: (f / "masks" / "00007.png").write_bytes((f / "masks" / "00007.png").read_bytes()[:60]),
        r"masks/00007\.png cannot be read",
    ),
    "a table that is gone": (
        lambda f: (f / "frames.csv").unlink(),
        r"strict/frames\.csv does not exist",
    ),
}


@pytest.mark.parametrize("name", DISAGREEMENTS)
def test_what_does_not_agree_is_named(name: str, results: Path) -> None:
    edit, sentence = DISAGREEMENTS[name]
    edit(results.parent / "strict")
    before = results.read_bytes()
    with pytest.raises(UserError, match=sentence):
        verify(results, ["strict"], lambda _: None)
    assert results.read_bytes() == before and b"verified" not in before


def test_a_figure_that_the_program_gets_wrong_is_found(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first computation is not asked again: an error in it cannot hide."""
    real = measure_module.weighted_mean
    monkeypatch.setattr(measure_module, "weighted_mean", lambda values, mask: real(values, mask) * 1.0001)
    results = evaluate(make_run(tmp_path / "run", subject), ["strict"], write_frames=True, say=lambda _: None)
    with pytest.raises(UserError, match="psnr of frame 00008 is"):
        verify(results, say=lambda _: None)


def test_a_flicker_that_the_program_does_not_see_is_found(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = jitter_module.weighted_mean
    monkeypatch.setattr(jitter_module, "weighted_mean", lambda values, mask: real(values, mask) * 0.999)
    results = evaluate(make_run(tmp_path / "run", subject), ["strict"], write_frames=True, say=lambda _: None)
    with pytest.raises(UserError, match="jitter of frame 00009 is"):
        verify(results, say=lambda _: None)


def test_floats_are_said_not_to_be_in_the_pictures(tmp_path: Path, subject: Subject, results: Path) -> None:
    edit_entry(results.parent / "strict", choices={"levels": "float"})
    said: list[str] = []
    verify(results, ["strict"], said.append)
    assert said == ["strict: not verified, because it measures floats, which no PNG file holds (levels: float)"]
    assert "verified" not in json.loads(results.read_text())["protocols"]["strict"]


def test_frames_of_any_name_are_measured_verified_and_kept(tmp_path: Path, subject: Subject) -> None:
    """Files of another encoding, and names with what other programs take for the end of a line."""
    odd = "caf\udce9", 'a\u2028\x85,"b'
    of = {index: odd[n % len(odd)] for n, index in enumerate(subject.split.test)}
    assert len(of) >= len(odd)
    frames = tuple(replace(frame, name=of.get(i, "") + frame.name) for i, frame in enumerate(subject.manifest.frames))
    manifest = replace(subject.manifest, frames=frames)
    recording = replace(subject.recording, names=tuple(frame.name for frame in frames))
    run = make_run(tmp_path / "run", replace(subject, manifest=manifest, recording=recording))
    verify(evaluate(run, ["hypergaussians"], write_frames=True, say=lambda _: None), say=lambda _: None)
    results = json.loads(evaluate(run, ["flashavatar"], say=lambda _: None).read_text())
    assert list(results["protocols"]) == ["hypergaussians", "flashavatar"]
