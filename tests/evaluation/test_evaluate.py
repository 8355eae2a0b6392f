"""Evaluation of a run, end to end on a small subject: every figure can be recomputed from the files that it writes."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from avatar.data.manifest import MANIFEST_FILE, TRACKS_FILE, FrameRecord, Manifest
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.evaluation import draw as draw_module
from avatar.evaluation import evaluate as evaluate_module
from avatar.evaluation import measure as measure_module
from avatar.evaluation.evaluate import evaluate
from avatar.evaluation.protocol import MEASURES, builtin_protocols, choose_protocols
from avatar.losses.lpips import lpips_folder, save_lpips
from avatar.losses.lpips_network import Lpips
from avatar.splat import splat
from avatar.types import Camera, Frame, Gaussians, HeadParams, Rendering

SIZE, COUNT, TEST = 72, 10, (7, 8, 9)
SKIMAGE = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255, "channel_axis": 2}


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("AVATAR_LPIPS", raising=False)
    monkeypatch.setattr(evaluate_module, "Renderer", BlobRenderer)


@pytest.fixture
def subject(tmp_path: Path) -> Subject:
    """A disc that changes colour: images, a matte, a head mask with a soft rim, a mouth that is hidden in frame 8."""
    source, prepared = tmp_path / "source", tmp_path / "prepared"
    source.mkdir()
    prepared.mkdir()
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    radius = np.hypot(x - SIZE / 2, y - SIZE / 2)
    records = []
    for index in range(COUNT):
        stem = f"{index + 1:05d}"
        pixels = np.stack((100 + 10 * index + x, 200 - y, 40 + radius), axis=-1).clip(0, 255).astype(np.uint8)
        head = ((26 - radius) * 80).clip(0, 255).astype(np.uint8)
        mouth = np.where((abs(y - 48) < 5) & (abs(x - 36) < 9) & (index != 8), 255, 0).astype(np.uint8)
        alpha = ((30 - radius) * 60).clip(0, 255).astype(np.uint8)
        for kind, picture in (("image", pixels), ("alpha", alpha), ("head", head), ("mouth", mouth)):
            assert cv2.imwrite(str(source / f"{stem}_{kind}.png"), picture)
        names = [f"{stem}_{kind}.png" for kind in ("image", "alpha", "head", "mouth")]
        records.append(FrameRecord(stem, names[0], index, *names[1:]))
    manifest = Manifest(
        name="disc",
        format="metrical-tracker",
        source=str(source),
        tracking=str(source),
        head_path=str(source),
        width=SIZE,
        height=SIZE,
        fps=20.0,
        intrinsics=(SIZE, SIZE, SIZE / 2, SIZE / 2),
        frame_offset=1,
        offset_evidence="written by a test",
        frames=tuple(records),
        train=tuple(range(TEST[0])),
        test=TEST,
        left_out={},
        notes=(),
        head_masks="source",
        mouth_masks="source",
        head_fingerprint="ab" * 32,
        input_hash="cd" * 32,
        data_hash="ef" * 32,
    )
    (prepared / MANIFEST_FILE).write_text(manifest.to_json())
    tracks = {
        "expression": torch.linspace(0, 1, COUNT)[:, None].repeat(1, 3),
        "jaw": torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(COUNT, 1),
        "eyes": torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(COUNT, 2),
        "eyelids": torch.zeros(COUNT, 2),
        "neck": torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(COUNT, 1),
        "R": torch.eye(3).repeat(COUNT, 1, 1),
        "t": torch.tensor([0.0, 0.0, 1.0]).repeat(COUNT, 1),
        "shape": torch.zeros(2),
    }
    save_file(tracks, prepared / TRACKS_FILE)
    return Subject.open(prepared)


# the corners of two eyeballs: with a focal length of SIZE at 1 m, pixels 18 to 30 and 42 to 54 across, 24 to 32 down
EYES = torch.tensor([[18.0, 24.0], [30.0, 32.0], [42.0, 24.0], [54.0, 32.0]]).sub(SIZE / 2).div(SIZE)
EYES = torch.cat((EYES, torch.zeros(4, 1)), dim=1)


class Blob:
    """Stands in for a trained avatar: Gaussians on a disc whose colour follows the first expression coefficient."""

    def __init__(self, eyeballs: bool = True) -> None:
        regions = {"left_eyeball": torch.tensor([0, 1]), "right_eyeball": torch.tensor([2, 3])} if eyeballs else {}
        assets = SimpleNamespace(fingerprint="ab" * 32, regions=regions)
        self.head = SimpleNamespace(assets=assets, vertices=lambda _: EYES)
        self.seen: list[float] = []
        generator = torch.Generator().manual_seed(1)
        self.means = torch.cat((torch.rand(400, 2, generator=generator) * 0.6 - 0.3, torch.zeros(400, 1)), dim=1)

    def __call__(self, params: HeadParams) -> Gaussians:
        assert not torch.is_grad_enabled()
        self.seen.append(float(params.expression[0]))
        return Gaussians(
            means=self.means,
            quats=torch.tensor([1.0, 0, 0, 0]).repeat(400, 1),
            scales=torch.full((400, 3), 0.03),
            opacities=torch.full((400,), 0.9),
            sh=torch.full((400, 1, 3), float(params.expression[0])),
        )


class BlobRenderer:
    """Stands in for `avatar.render.Renderer`."""

    def __init__(self, avatar: Blob, background: torch.Tensor) -> None:
        self.avatar, self.background = avatar, background

    def gaussians(self, params: HeadParams) -> Gaussians:
        return self.avatar(params)

    def render(self, params: HeadParams, camera: Camera) -> Rendering:
        return splat(self.avatar(params), camera, self.background)


def make_run(path: Path, subject: Subject) -> Any:
    data = SimpleNamespace(size=None, background=(1.0, 1.0, 1.0), cache_mb=16, workers=1)
    config = SimpleNamespace(data=data, to_dict=lambda: {"data": {"size": None}})
    return SimpleNamespace(path=path, config=config, avatar=Blob(), subject=subject, step=1500)


def read_png(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


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
            file = f"{int(row['frame']):05d}.png"
            render, truth, head, mouth = (
                read_png(folder / kind / file).astype(float) for kind in ("renders", "gt", "masks", "mouth_masks")
            )
            weight = head[..., None] / 255.0 if protocol.mask == "multiply" else 1.0
            a, b = render * weight, truth * weight
            assert float(row["psnr"]) == pytest.approx(peak_signal_noise_ratio(b, a, data_range=255), abs=1e-6)
            assert float(row["ssim"]) == pytest.approx(structural_similarity(a, b, **SKIMAGE), abs=1e-6)
            error = ((render - truth) ** 2).mean(axis=2) / 255.0**2
            assert float(row["psnr_head"]) == pytest.approx(-10 * np.log10(np.average(error, weights=head)), abs=1e-6)
            if row["name"] == "00009":
                assert row["psnr_mouth"] == "nan" and not mouth.any()
            else:
                expected = -10 * np.log10(np.average(error, weights=mouth))
                assert float(row["psnr_mouth"]) == pytest.approx(expected, abs=1e-6)
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
        kinds = ("renders", "gt", "masks", "mouth_masks", "eyes_masks", "rest_masks")
        render, truth, head, mouth, eyes, rest = (read_png(folder / kind / file).astype(float) for kind in kinds)
        columns, lines = np.arange(SIZE) + 0.5, np.arange(SIZE)[:, None] + 0.5
        left, right = (abs(columns - middle) <= 6 * 1.5 for middle in (24, 48))  # a quarter of 12 more on either side
        box = (left | right) & (abs(lines - 28) <= 4 * 1.5)
        assert (eyes == head * box * (mouth == 0)).all() and (rest == head * ~box * (mouth == 0)).all()
        error = ((render - truth) ** 2).mean(axis=2) / 255.0**2
        _, similarity = structural_similarity(render, truth, full=True, **SKIMAGE)
        inside = (slice(5, -5), slice(5, -5))
        for region, mask in (("eyes", eyes), ("rest", rest)):
            expected = -10 * np.log10(np.average(error, weights=mask))
            assert float(row[f"psnr_{region}"]) == pytest.approx(expected, abs=1e-6), name
            expected = np.average(similarity.mean(axis=2)[inside], weights=mask[inside])
            assert float(row[f"ssim_{region}"]) == pytest.approx(expected, abs=1e-6), name


def test_a_head_model_without_eyeballs_has_no_figure_for_eyes(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    run.avatar = Blob(eyeballs=False)
    results = json.loads(evaluate(run, ["strict"], say=lambda _: None).read_text())
    entry = results["protocols"]["strict"]
    assert all(entry["means"][f"{measure}_{region}"] is None for measure in MEASURES for region in ("eyes", "rest"))
    assert entry["means"]["psnr_head"] > 0
    assert "strict: eyes and rest not measured, because the head model names no left_eyeball" in results["notes"][0]


def test_protocols_measure_what_they_share_once(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five protocols over three backgrounds: three renderings and, with one masked pair, four SSIM maps a frame."""
    calls: list[str] = []
    for module, name in ((draw_module, "splat"), (measure_module, "ssim_map")):
        real = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, real=real, name=name: (calls.append(name), real(*a))[1])
    evaluate(make_run(tmp_path / "run", subject), say=lambda _: None)
    worst = 3  # drawn again for the contact sheet
    assert (calls.count("splat"), calls.count("ssim_map")) == (3 * len(TEST) + worst, 4 * len(TEST))


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


def test_bins_intervals_worst_frames_and_speed_are_in_the_results(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    said: list[str] = []
    results = json.loads(evaluate(run, say=said.append).read_text())
    entry = results["protocols"]["hypergaussians"]
    rows = list(csv.DictReader((run.path / "eval" / "hypergaussians" / "frames.csv").open()))
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
    rendering = results["rendering"]
    assert (rendering["width"], rendering["height"], rendering["frames"]) == (SIZE, SIZE, 3)
    assert rendering["frames_per_second"] == pytest.approx(1000 / rendering["median_ms"])
    assert results["image_size"] == [SIZE, SIZE]
    assert f"{low:.2f} - {high:.2f}" in said[0] and f"worst frames, main PSNR        {order[0]['name']}" in said[0]
    sheet = read_png(run.path / "eval" / "worst.png")
    assert sheet.shape[1] == 2 * 3 * SIZE  # two columns of truth, render and error
    assert sheet.shape[0] % 2 == 0 and (sheet[-1, -1] == 255).all()  # three panels: the last place is empty
    assert read_png(run.path / "eval" / "curves.png").std() > 10


def test_an_avatar_without_error_has_no_worst_frame(
    tmp_path: Path, subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Infinite PSNR is no figure: results stay valid JSON, and there is nothing to look at."""
    monkeypatch.setattr(
        draw_module, "splat", lambda gaussians, camera, colour: Rendering(colour.expand(SIZE, SIZE, 3), None)
    )
    monkeypatch.setattr(Frame, "composite", lambda self, colour: colour.expand(SIZE, SIZE, 3))
    run = make_run(tmp_path / "run", subject)
    said: list[str] = []
    entry = json.loads(evaluate(run, ["strict"], say=said.append).read_text())["protocols"]["strict"]
    assert entry["means"]["psnr"] is None and entry["means"]["ssim"] == 1.0 and entry["means"]["jitter"] == 0.0
    assert entry["worst"] == [] and entry["intervals"]["psnr"] is None and entry["intervals"]["ssim"] == [1.0, 1.0]
    assert not (run.path / "eval" / "worst.png").exists() and "worst.png" not in said[1]


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


def test_results_name_every_choice(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    said: list[str] = []
    results = json.loads(evaluate(run, say=said.append).read_text())
    assert results["data_hash"] == "ef" * 32 and results["head_fingerprint"] == "ab" * 32 and results["step"] == 1500
    assert results["config"] == {"data": {"size": None}}
    assert results["versions"]["torch"] == torch.__version__
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
        assert "not measured (no LPIPS weights for 'vgg'" in entry["lpips"]["note"]
        assert not (run.path / "eval" / protocol.name / "renders").exists()
    green, black = results["notes"]
    assert green.startswith("flashavatar: drawn over green, trained over white; ")
    assert black.startswith("rgbavatar: drawn over black, trained over white; ")
    table, places = said
    assert f"Note: {green}" in table and f"Note: {black}" in table
    assert str(run.path / "eval" / "results.json") in places and "truth_render_error.mp4" in places
    assert table.count("not measured") == 1
    for name in builtin_protocols():
        assert f"\n{name}" in table and f"{results['protocols'][name]['means']['psnr']:.2f}" in table


def test_lpips_of_another_network_is_labelled(tmp_path: Path, subject: Subject) -> None:
    lpips_folder().mkdir(parents=True)
    lpips = Lpips("squeeze")
    save_lpips(lpips, lpips_folder() / "lpips_squeeze.safetensors")
    run = make_run(tmp_path / "run", subject)
    results = json.loads(evaluate(run, ["hypergaussians"], write_frames=True, say=lambda _: None).read_text())
    entry = results["protocols"]["hypergaussians"]
    assert entry["lpips"]["network"] == "squeeze" and entry["lpips"]["weights_sha256"] == lpips.fingerprint()
    assert entry["lpips"]["note"].startswith("squeeze, not to be compared with figures of vgg: no LPIPS weights for")
    figures = []
    for index in TEST:
        kinds = ("renders", "gt", "masks")
        a, b, mask = (
            torch.from_numpy(read_png(run.path / "eval" / "hypergaussians" / kind / f"{index:05d}.png")) / 255.0
            for kind in kinds
        )
        figures.append(lpips(a.flip(-1) * mask[..., None], b.flip(-1) * mask[..., None]).item())
    assert entry["means"]["lpips"] == pytest.approx(np.mean(figures), rel=1e-5)


def test_video_shows_every_frame(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    evaluate(run, ["hypergaussians"], say=lambda _: None)
    reader = imageio.get_reader(run.path / "eval" / "truth_render_error.mp4")
    assert reader.get_meta_data()["fps"] == 20.0
    frames = [np.asarray(frame) for frame in reader]
    assert len(frames) == len(TEST) and frames[0].shape[1] == 3 * SIZE


def test_pictures_of_an_earlier_evaluation_do_not_stay(tmp_path: Path, subject: Subject) -> None:
    run = make_run(tmp_path / "run", subject)
    stale = run.path / "eval" / "insta350" / "renders" / "00001.png"
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"old")
    evaluate(run, ["insta350"], write_frames=True, say=lambda _: None)
    assert sorted(path.name for path in stale.parent.iterdir()) == ["00007.png", "00008.png", "00009.png"]


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
