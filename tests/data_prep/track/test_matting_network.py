"""Mattes by networks whose files a person has: small ones with the published inputs and outputs stand in for them.

Robust Video Matting: pha = downsample_ratio (mean of src's channels + r1i) / 2, r1o = that mean
MODNet:               output = (mean of input's channels + 1) / 2, of pictures whose sides are multiples of 32
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from heads import grid_head
from marked_face import picture
from onnx import TensorProto, helper
from videos import LOSSLESS, encode

from avatar import errors
from avatar.cli import main
from avatar.commands import models
from avatar.errors import UserError
from avatar.files.third_party import (
    FOLDER_VARIABLE,
    MODNET,
    ROBUST_VIDEO_MATTING,
    SELFIE_MULTICLASS,
    SELFIE_SEGMENTATION,
    ThirdPartyFile,
    sha256_of,
)
from avatar.pipeline.cached_tracking import tracking_lacks
from data_prep.track import track as tracking
from data_prep.track.mattes import clip_mattes, matting_network, segmentation_network
from data_prep.track.mattes.matting_network import open_matting
from data_prep.track.mattes.segmentation_network import matte_network
from data_prep.track.track import Choices, track

STATES = [f"r{i}" for i in range(1, 5)]


def published(folder: Path, file: ThirdPartyFile, nodes: list, inputs: dict, outputs: list[str]) -> ThirdPartyFile:
    """The network in a file of that name, and the entry that has its hash."""
    values = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]
        for shapes in (inputs, dict.fromkeys(outputs))
    ]
    two = helper.make_tensor("two", TensorProto.FLOAT, [1], [2.0])
    one = helper.make_tensor("one", TensorProto.FLOAT, [1], [1.0])
    axes, rows = (helper.make_tensor(name, TensorProto.INT64, [1], [n]) for name, n in (("axes", 1), ("rows", 2)))
    graph = helper.make_graph(nodes, "net", *values, [two, one, axes, rows])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    folder.mkdir(exist_ok=True)
    onnx.save(made, str(folder / file.name))
    return file._replace(sha256=sha256_of(folder / file.name))


@pytest.fixture
def rvm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ThirdPartyFile:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "models"))
    picture = [1, 3, "height", "width"]
    nodes = [
        helper.make_node("ReduceMean", ["src", "axes"], ["r1o"], keepdims=1),
        helper.make_node("Add", ["r1o", "r1i"], ["sum"]),
        helper.make_node("Div", ["sum", "two"], ["half"]),
        helper.make_node("Mul", ["half", "downsample_ratio"], ["pha"]),
        helper.make_node("Identity", ["src"], ["fgr"]),
        *(helper.make_node("Add", [f"{name}i", "one"], [f"{name}o"]) for name in STATES[1:]),
    ]
    inputs = {"src": picture} | {f"{name}i": [1, f"{name}c", f"{name}h", f"{name}w"] for name in STATES}
    outputs = ["fgr", "pha", *(f"{name}o" for name in STATES)]
    return published(tmp_path / "models", ROBUST_VIDEO_MATTING, nodes, inputs | {"downsample_ratio": [1]}, outputs)


@pytest.fixture
def modnet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ThirdPartyFile:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "models"))
    nodes = [
        helper.make_node("ReduceMean", ["input", "axes"], ["mean"], keepdims=1),
        helper.make_node("Add", ["mean", "one"], ["sum"]),
        helper.make_node("Div", ["sum", "two"], ["output"]),
    ]
    return published(tmp_path / "models", MODNET, nodes, {"input": [1, 3, "height", "width"]}, ["output"])


def grey(value: int, height: int = 30, width: int = 40) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def test_robust_video_matting_remembers_the_frame_before(rvm: ThirdPartyFile) -> None:
    matte = open_matting(rvm)
    made = [matte(grey(value)) for value in (100, 200, 0, 255)]
    assert [np.unique(each).tolist() for each in made] == [[50], [150], [100], [128]]
    assert made[0].shape == (30, 40) and made[0].dtype == np.uint8
    assert open_matting(rvm)(grey(100))[0, 0] == 50  # a clip begins without a memory


def test_robust_video_matting_works_at_512_pixels(rvm: ThirdPartyFile) -> None:
    assert open_matting(rvm)(grey(200, 64, 1024))[0, 0] == 50  # the ratio is a half


@pytest.mark.parametrize("size", [(512, 512), (300, 411), (1080, 720), (16, 600)])
def test_modnet_sees_multiples_of_32_pixels(modnet: ThirdPartyFile, size: tuple[int, int]) -> None:
    matte = open_matting(modnet)
    ramp = np.repeat(np.linspace(0, 255, size[1])[None, :, None], size[0], axis=0).repeat(3, axis=2)
    ramp = np.rint(ramp).astype(np.uint8)
    found = matte(ramp)
    assert found.shape == size
    assert np.abs(found.astype(int) - ramp[..., 0]).max() <= 6
    channels = np.zeros((*size, 3), np.uint8)
    channels[..., 0] = 255
    np.testing.assert_array_equal(matte(channels), 85)


def test_what_is_there_is_taken_the_best_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    assert matte_network() == SELFIE_SEGMENTATION
    for file in (SELFIE_MULTICLASS, MODNET, ROBUST_VIDEO_MATTING):
        (tmp_path / file.name).touch()
        assert matte_network() == file


def test_what_cannot_be_run_is_refused(rvm: ThirdPartyFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "models" / rvm.name
    with pytest.raises(UserError, match=f"{file} is not the published file"):
        open_matting(ROBUST_VIDEO_MATTING)
    file.write_bytes(b"no network")
    with pytest.raises(UserError, match=f"onnxruntime cannot load {file}"):
        open_matting(rvm._replace(sha256=sha256_of(file)))
    monkeypatch.setattr(errors, "find_spec", lambda _: None)
    with pytest.raises(UserError, match="needs onnxruntime"):
        open_matting(rvm)


@pytest.mark.parametrize(
    ("given", "made", "axis"), [("photo", "output", 1), ("input", "alpha", 1), ("input", "output", 2)]
)
def test_a_network_with_other_inputs_or_outputs_is_refused_before_the_video_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str, made: str, axis: int
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "models"))
    nodes = [helper.make_node("ReduceMean", [given, "axes" if axis == 1 else "rows"], [made], keepdims=1)]
    wrong = published(tmp_path / "models", MODNET, nodes, {given: [1, 3, "height", "width"]}, [made])
    for module in (tracking, matting_network, segmentation_network):
        monkeypatch.setattr(module, "MATTING_FILES", (wrong,))
    said = f"{tmp_path}/models/modnet.onnx makes no matte of a picture"
    assert any(said in lack for lack in tracking_lacks())
    monkeypatch.setattr(tracking, "growing", pytest.fail)
    video = encode(tmp_path / "v.mkv", [picture(0)] * 2, options=LOSSLESS)
    (tmp_path / "head.npz").touch()
    with pytest.raises(UserError, match=said):
        track(video, tmp_path / "out", tmp_path / "head.npz", grid_head())


def test_the_command_lists_them_and_fetches_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    monkeypatch.setenv("AVATAR_CACHE", str(tmp_path / "cache"))
    for name in ("TRACKING_FILES", "PAGE_FILES", "FETCHED_LPIPS", "NETS"):
        monkeypatch.setattr(models, name, ())
    assert main(["models", "--download"]) == 0
    said = capsys.readouterr().out
    assert "rvm_mobilenetv3_fp32.onnx" in said and "GPL-3.0" in said and ROBUST_VIDEO_MATTING.sha256 in said
    assert "modnet.onnx" in said and MODNET.sha256 in said and "fetching" not in said
    assert not (tmp_path / "cache" / "models").exists()


def test_tracking_gives_the_frames_in_order(
    rvm: ThirdPartyFile, with_marks: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (tracking, clip_mattes, segmentation_network, matting_network):
        monkeypatch.setattr(module, "MATTING_FILES", (rvm,))
    frames = [picture(n % 5) + np.uint8(4 * n) * (picture(n % 5) == 90) for n in range(12)]
    video = encode(tmp_path / "v.mkv", frames, options=LOSSLESS)
    (tmp_path / "head.npz").touch()
    said: list[str] = []
    track(video, tmp_path / "out", tmp_path / "head.npz", grid_head(), Choices(crop="none"), say=said.append)
    assert "mattes by rvm_mobilenetv3_fp32.onnx" in said
    before = 0.0
    for number, frame in enumerate(frames):
        mean = frame.mean(axis=2)
        found = cv2.imread(str(tmp_path / "out" / "matte" / f"{number:05d}.png"), cv2.IMREAD_GRAYSCALE)
        inside = np.s_[95:, 100:]  # away from the marks, which JPEG blurs
        assert np.abs(found - (mean + before) / 2)[inside].max() < 3.0, number
        before = mean
