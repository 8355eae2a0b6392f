"""What each protocol measures, recomputed with scikit-image from the pictures."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from avatar.evaluation.measure import LPIPS_CROP, Figures, FrameMeasurer, Pair, as_seen, lpips_crop
from avatar.evaluation.protocol import ImageFormat, Protocol, choose_protocols
from avatar.losses.lpips_network import Lpips
from avatar.tensors import to_8_bit

PROTOCOLS = {protocol.name: protocol for protocol in choose_protocols(None)}
SKIMAGE = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255, "channel_axis": 2}


def pictures(height: int = 90, width: int = 100) -> tuple[torch.Tensor, ...]:
    truth = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8)
    noise = torch.randint(-30, 31, truth.shape)
    render = (truth.int() + noise).clamp(0, 255).to(torch.uint8)
    head = torch.zeros(height, width, dtype=torch.uint8)
    head[10:80, 20:90] = 255
    head[9, 20:90] = 100
    mouth = torch.zeros_like(head)
    mouth[50:60, 40:60] = 255
    return render, truth, head, mouth


def measure(protocol: Protocol, render: Any, truth: Any, head: Any, mouth: Any, lpips: Lpips | None = None) -> Figures:
    masks = {"head": head, "mouth": mouth}
    return FrameMeasurer({protocol.image_format: Pair(render, truth)}, masks, {protocol.lpips_net: lpips}).measure(
        protocol
    )


@pytest.mark.parametrize("name", PROTOCOLS)
def test_main_figures_are_those_of_scikit_image(name: str) -> None:
    render, truth, head, mouth = pictures()
    figures = measure(PROTOCOLS[name], render, truth, head, mouth)
    weight = head.numpy()[..., None] / 255.0 if PROTOCOLS[name].mask == "multiply" else 1.0
    a, b = render.numpy() * weight, truth.numpy() * weight
    assert figures["psnr"] == pytest.approx(peak_signal_noise_ratio(b, a, data_range=255), abs=1e-9)
    assert figures["ssim"] == pytest.approx(structural_similarity(a, b, **SKIMAGE), abs=1e-7)
    assert math.isnan(figures["lpips"]) and math.isnan(figures["lpips_mouth"])


@pytest.mark.parametrize("name", PROTOCOLS)
def test_region_figures_are_means_over_the_mask(name: str) -> None:
    render, truth, head, mouth = pictures()
    figures = measure(PROTOCOLS[name], render, truth, head, mouth)
    a, b = render.numpy().astype(float), truth.numpy().astype(float)
    _, ssim_map = structural_similarity(a, b, full=True, **SKIMAGE)
    for region, mask in (("head", head.numpy()), ("mouth", mouth.numpy())):
        error = np.average(((a - b) ** 2).mean(axis=2), weights=mask) / 255.0**2
        assert figures[f"psnr_{region}"] == pytest.approx(-10 * np.log10(error), abs=1e-9)
        expected = np.average(ssim_map.mean(axis=2)[5:-5, 5:-5], weights=mask[5:-5, 5:-5])
        assert figures[f"ssim_{region}"] == pytest.approx(expected, abs=1e-7)


def test_multiplying_by_the_mask_raises_psnr_by_the_share_of_the_mask() -> None:
    render, truth, _, mouth = pictures()
    head = torch.zeros(90, 100, dtype=torch.uint8)
    head[:45, :50] = 255
    figures = measure(PROTOCOLS["hypergaussians"], render, truth, head, mouth)
    assert figures["psnr"] == pytest.approx(figures["psnr_head"] + 10 * math.log10(4), abs=1e-9)


def test_mask_only_makes_the_main_figures_those_of_the_head() -> None:
    only = dataclasses.replace(PROTOCOLS["flashavatar"], mask="only", lpips_net="squeeze")
    figures = measure(only, *pictures(), Lpips("squeeze"))
    for name in ("psnr", "ssim", "lpips"):
        assert figures[name] == figures[f"{name}_head"] != figures[f"{name}_mouth"]


def test_lpips_of_regions_is_of_the_masked_crop() -> None:
    render, truth, head, mouth = pictures()
    lpips = Lpips("squeeze")
    figures = measure(PROTOCOLS["hypergaussians"], render, truth, head, mouth, lpips)
    weight = (head / 255.0)[..., None]
    a, b = render / 255.0 * weight, truth / 255.0 * weight
    assert figures["lpips"] == pytest.approx(lpips(a, b).item(), rel=1e-5)
    assert figures["lpips_head"] == pytest.approx(lpips(a[9:80, 20:90], b[9:80, 20:90]).item(), rel=1e-5)
    box = lpips_crop(mouth)
    assert box == (slice(23, 87), slice(18, 82))
    weight = (mouth / 255.0)[..., None]
    expected = lpips((render / 255.0 * weight)[box], (truth / 255.0 * weight)[box]).item()
    assert figures["lpips_mouth"] == pytest.approx(expected, rel=1e-5)


def test_lpips_is_scaled_as_the_protocol_says() -> None:
    given, lpips = pictures(), Lpips("squeeze")
    plain = measure(PROTOCOLS["flashavatar"], *given, lpips)
    scaled = measure(dataclasses.replace(PROTOCOLS["flashavatar"], lpips_scale=0.05), *given, lpips)
    for name in ("lpips", "lpips_head", "lpips_mouth"):
        assert scaled[name] == pytest.approx(0.05 * plain[name], rel=1e-12) and plain[name] > 0
    assert scaled["psnr"] == plain["psnr"]


@pytest.mark.parametrize("size", [20, LPIPS_CROP, 200])
@pytest.mark.parametrize("corner", [(0, 0), (-1, -1), (0, -1)])
def test_crop_stays_inside_the_image_and_holds_the_mask(size: int, corner: tuple[int, int]) -> None:
    mask = torch.zeros(size, size)
    mask[corner] = 1.0
    crop = lpips_crop(mask)
    assert crop is not None
    assert mask[crop].shape == (min(size, LPIPS_CROP),) * 2 and mask[crop].sum() == 1.0


def test_a_hidden_mouth_has_no_figure() -> None:
    render, truth, head, mouth = pictures()
    figures = measure(PROTOCOLS["flashavatar"], render, truth, head, torch.zeros_like(mouth), Lpips("squeeze"))
    assert all(math.isnan(figures[f"{name}_mouth"]) for name in ("psnr", "ssim", "lpips"))
    assert all(math.isfinite(figures[name]) for name in ("psnr", "ssim", "lpips", "psnr_head", "lpips_head"))


def test_levels_are_rounded_or_cut_and_floats_stay() -> None:
    values = torch.tensor([-0.2, 0.0, 0.49 / 255, 0.51 / 255, 99.4 / 255, 99.6 / 255, 1.0, 1.7])
    assert to_8_bit(values).tolist() == [0, 0, 0, 1, 99, 100, 255, 255]
    assert to_8_bit(values, truncate=True).tolist() == [0, 0, 0, 0, 99, 99, 255, 255]
    white = (1.0, 1.0, 1.0)
    assert torch.equal(as_seen(values, ImageFormat(white, True, "round")), to_8_bit(values))
    assert torch.equal(as_seen(values, ImageFormat(white, True, "float")), values.clamp(0, 1))
    assert torch.equal(as_seen(values, ImageFormat(white, False, "float")), values)


def test_truncation_keeps_the_levels_of_8_bit_files() -> None:
    levels = torch.arange(256)
    assert torch.equal(to_8_bit(levels.float() / 255.0, truncate=True).long(), levels)


def test_unclamped_floats_are_measured_as_they_are() -> None:
    protocol = dataclasses.replace(PROTOCOLS["flashavatar"], clamp=False, levels="float")
    _, _, head, mouth = pictures()
    truth = torch.zeros(90, 100, 3)
    render = torch.full_like(truth, -0.1)
    assert measure(protocol, render, truth, head, mouth)["psnr"] == pytest.approx(20.0, abs=1e-6)
