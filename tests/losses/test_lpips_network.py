"""LPIPS against an independent graph (ONNX export of the reference) and against a functional re-derivation."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import torchmetrics
from torch import Tensor

from avatar.files.third_party import LPIPS_FILES, ThirdPartyFile
from avatar.losses.lpips import from_published, load_lpips
from avatar.losses.lpips_network import CHANNELS, NETS, Lpips, Net

ROOT = Path(__file__).resolve().parents[2]

# torchvision's `features` as its documentation prints them: (layer number, stride, padding) of a convolution, "F" for a
# Fire module, "P" for a pool (kernel, stride, ceil_mode), "T" for LPIPS's tap on what came before
WRITTEN_OUT: dict[str, list[tuple]] = {
    "vgg": [
        *((0, 1, 1), (2, 1, 1), ("T",), ("P", 2, 2, False), (5, 1, 1), (7, 1, 1), ("T",), ("P", 2, 2, False)),
        *((10, 1, 1), (12, 1, 1), (14, 1, 1), ("T",), ("P", 2, 2, False)),
        *((17, 1, 1), (19, 1, 1), (21, 1, 1), ("T",), ("P", 2, 2, False), (24, 1, 1), (26, 1, 1), (28, 1, 1), ("T",)),
    ],
    "alex": [
        *((0, 4, 2), ("T",), ("P", 3, 2, False), (3, 1, 2), ("T",), ("P", 3, 2, False)),
        *((6, 1, 1), ("T",), (8, 1, 1), ("T",), (10, 1, 1), ("T",)),
    ],
    "squeeze": [
        *((0, 2, 0), ("T",), ("P", 3, 2, True), ("F", 3), ("F", 4), ("T",), ("P", 3, 2, True)),
        *(("F", 6), ("F", 7), ("T",), ("P", 3, 2, True), ("F", 9), ("T",), ("F", 10), ("T",)),
        *(("F", 11), ("T",), ("F", 12), ("T",)),
    ],
}


def taps_written_out(net: Net, state: dict[str, Tensor], image: Tensor) -> list[Tensor]:
    def conv(x: Tensor, name: str, stride: int = 1, padding: int = 0) -> Tensor:
        weight, bias = state[f"features.{name}.weight"], state[f"features.{name}.bias"]
        return F.conv2d(x, weight, bias, stride, padding).clamp(min=0)

    shift = torch.tensor([-0.030, -0.088, -0.188])
    scale = torch.tensor([0.458, 0.448, 0.450])
    x = ((2 * image - 1 - shift) / scale).permute(2, 0, 1)[None]
    taps = []
    for step in WRITTEN_OUT[net]:
        if step[0] == "T":
            taps.append(x)
        elif step[0] == "P":
            x = F.max_pool2d(x, step[1], step[2], ceil_mode=step[3])
        elif step[0] == "F":
            squeezed = conv(x, f"{step[1]}.squeeze")
            wide = conv(squeezed, f"{step[1]}.expand3x3", padding=1)
            x = torch.cat((conv(squeezed, f"{step[1]}.expand1x1"), wide), dim=1)
        else:
            x = conv(x, str(step[0]), step[1], step[2])
    return taps


@pytest.mark.parametrize("net", NETS)
def test_agrees_with_the_definition_written_out(net: Net) -> None:
    lpips = Lpips(net)
    state = lpips.state_dict()
    image, target = torch.rand(2, 61, 48, 3)
    expected = 0.0
    layers = zip(taps_written_out(net, state, image), taps_written_out(net, state, target), strict=True)
    for index, (first, second) in enumerate(layers):
        unit = [tap / tap.square().sum(dim=1, keepdim=True).sqrt() for tap in (first, second)]
        assert first.shape[1] == CHANNELS[net][index]
        expected += torch.einsum("nchw,c->nhw", (unit[0] - unit[1]) ** 2, state[f"heads.{index}"]).mean().item()
    assert lpips(image, target).item() == pytest.approx(expected, rel=1e-5)
    assert lpips(image, image).item() == 0.0


@pytest.mark.parametrize("net", NETS)
def test_published_linear_heads_fit(net: Net, tmp_path: Path) -> None:
    """torchmetrics carries the linear heads as published: the SHA-256 that we ask for, and the shapes."""
    heads = Path(torchmetrics.__file__).parent / "functional" / "image" / "lpips_models" / f"{net}.pth"
    (tmp_path / f"lin_v0.1_{net}.pth").write_bytes(heads.read_bytes())
    backbone = Lpips(net)
    state = {name: tensor for name, tensor in backbone.state_dict().items() if name.startswith("features.")}
    torch.save(state, tmp_path / "backbone.pth")
    lpips = from_published(net, tmp_path, (ThirdPartyFile("backbone.pth", "", "", 600), LPIPS_FILES[net][1]))
    published = torch.load(heads, map_location="cpu", weights_only=True)
    for index, head in enumerate(lpips.heads):
        torch.testing.assert_close(head.data, published[f"lin{index}.model.1.weight"].flatten())
    image, target = torch.rand(2, 40, 40, 3)
    assert lpips(image, target).item() > 0  # the published heads have no negative weight


@pytest.mark.parametrize("net", NETS)
def test_gradient_is_finite_where_features_vanish(net: Net) -> None:
    """Frames times a mask are black around the head; biases are zero here, so that whole taps are zero too."""
    lpips = Lpips(net)
    for name, parameter in lpips.named_parameters():
        if name.endswith("bias"):
            parameter.zero_()
    lpips.shift.fill_(-1.0)
    image = torch.zeros(64, 64, 3)
    image[20:30, 20:30] = torch.rand(10, 10, 3)
    image.requires_grad_()
    lpips(image, torch.zeros(64, 64, 3)).backward()
    assert image.grad is not None and image.grad.isfinite().all() and image.grad.any()


def test_gradient_agrees_with_finite_differences() -> None:
    lpips = Lpips("squeeze").double()
    image, target = torch.rand(2, 33, 35, 3, dtype=torch.float64)
    direction = torch.randn_like(image)
    image.requires_grad_()
    lpips(image, target).backward()
    assert image.grad is not None
    step = 1e-6
    with torch.no_grad():
        slope = (lpips(image + step * direction, target) - lpips(image - step * direction, target)) / (2 * step)
    assert (image.grad * direction).sum().item() == pytest.approx(slope.item(), rel=1e-5)


def test_weights_are_frozen_and_small_images_refused() -> None:
    lpips = Lpips("alex")
    assert not any(parameter.requires_grad for parameter in lpips.parameters())
    with pytest.raises(ValueError, match="LPIPS needs images of at least 32 x 32 pixels, got 40 x 31"):
        lpips(torch.zeros(31, 40, 3), torch.zeros(31, 40, 3))
    for size in (32, 33):
        assert lpips(torch.zeros(size, 32, 3), torch.ones(size, 32, 3)).isfinite()


@pytest.fixture(scope="session")
def onnx_file(shared_dir: Path) -> Path:
    return shared_dir / "assets" / "lpips" / "lpips_sq.onnx"


@pytest.mark.shared
@pytest.mark.parametrize(("height", "width"), [(32, 32), (33, 64), (128, 97), (256, 256)])
def test_squeeze_agrees_with_the_onnx_graph(
    onnx_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, height: int, width: int
) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    script = ROOT / "scripts" / "lpips_from_onnx.py"
    monkeypatch.setattr(sys, "argv", [str(script), str(onnx_file), str(tmp_path / "lpips_squeeze.safetensors")])
    runpy.run_path(str(script), run_name="__main__")
    lpips = load_lpips("squeeze", tmp_path)
    session = onnxruntime.InferenceSession(str(onnx_file))
    y, x = torch.meshgrid(torch.linspace(0, 6, height), torch.linspace(0, 5, width), indexing="ij")
    target = torch.stack((x.sin(), (x + y).cos(), (2 * y).sin()), dim=-1) * 0.5 + 0.5
    for noise in (0.02, 0.3):
        image = (target + noise * torch.randn_like(target)).clamp(0, 1)
        mean, std = np.float32([0.485, 0.456, 0.406]), np.float32([0.229, 0.224, 0.225])
        feeds = {
            name: ((tensor.numpy() - mean) / std).transpose(2, 0, 1)[None]
            for name, tensor in (("ref", target), ("dist", image))
        }
        expected = float(session.run(None, feeds)[0].item())
        assert lpips(image, target).item() == pytest.approx(expected, abs=1e-5, rel=1e-4)
        assert lpips(target, image).item() == pytest.approx(expected, abs=1e-5, rel=1e-4)
