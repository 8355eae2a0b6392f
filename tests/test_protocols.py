"""What each protocol measures, recomputed with scikit-image from the pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from avatar.data.split import Split
from avatar.errors import UserError
from avatar.lpips_network import Lpips
from avatar.protocols import LPIPS_CROP, PROTOCOLS, choose_protocols, lpips_crop, measure, to_8_bit

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


@pytest.mark.parametrize("name", PROTOCOLS)
def test_full_frame_figures_are_those_of_scikit_image(name: str) -> None:
    render, truth, head, mouth = pictures()
    figures = measure(PROTOCOLS[name], render, truth, head, mouth, None)
    weight = head.numpy()[..., None] / 255.0 if PROTOCOLS[name].multiply else 1.0
    a, b = render.numpy() * weight, truth.numpy() * weight
    assert figures["psnr"] == pytest.approx(peak_signal_noise_ratio(b, a, data_range=255), abs=1e-9)
    assert figures["ssim"] == pytest.approx(structural_similarity(a, b, **SKIMAGE), abs=1e-7)
    assert math.isnan(figures["lpips"]) and math.isnan(figures["lpips_mouth"])


@pytest.mark.parametrize("name", PROTOCOLS)
def test_region_figures_are_means_over_the_mask(name: str) -> None:
    render, truth, head, mouth = pictures()
    figures = measure(PROTOCOLS[name], render, truth, head, mouth, None)
    a, b = render.numpy().astype(float), truth.numpy().astype(float)
    _, ssim_map = structural_similarity(a, b, full=True, **SKIMAGE)
    for region, mask in (("masked", head.numpy()), ("mouth", mouth.numpy())):
        error = np.average(((a - b) ** 2).mean(axis=2), weights=mask) / 255.0**2
        assert figures[f"psnr_{region}"] == pytest.approx(-10 * np.log10(error), abs=1e-9)
        expected = np.average(ssim_map.mean(axis=2)[5:-5, 5:-5], weights=mask[5:-5, 5:-5])
        assert figures[f"ssim_{region}"] == pytest.approx(expected, abs=1e-7)


def test_multiplying_by_the_mask_raises_psnr_by_the_share_of_the_mask() -> None:
    render, truth, _, mouth = pictures()
    head = torch.zeros(90, 100, dtype=torch.uint8)
    head[:45, :50] = 255
    figures = measure(PROTOCOLS["hypergaussians"], render, truth, head, mouth, None)
    assert figures["psnr"] == pytest.approx(figures["psnr_masked"] + 10 * math.log10(4), abs=1e-9)


def test_lpips_of_regions_is_of_the_masked_crop() -> None:
    render, truth, head, mouth = pictures()
    lpips = Lpips("squeeze")
    figures = measure(PROTOCOLS["hypergaussians"], render, truth, head, mouth, lpips)
    weight = (head / 255.0)[..., None]
    a, b = render / 255.0 * weight, truth / 255.0 * weight
    assert figures["lpips"] == pytest.approx(lpips(a, b).item(), rel=1e-5)
    assert figures["lpips_masked"] == pytest.approx(lpips(a[9:80, 20:90], b[9:80, 20:90]).item(), rel=1e-5)
    box = lpips_crop(mouth)
    assert box == (slice(23, 87), slice(18, 82))
    weight = (mouth / 255.0)[..., None]
    expected = lpips((render / 255.0 * weight)[box], (truth / 255.0 * weight)[box]).item()
    assert figures["lpips_mouth"] == pytest.approx(expected, rel=1e-5)


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
    assert all(math.isfinite(figures[name]) for name in ("psnr", "ssim", "lpips", "psnr_masked", "lpips_masked"))


def test_eight_bits_are_clamped_and_rounded() -> None:
    values = torch.tensor([-0.2, 0.0, 0.49 / 255, 0.51 / 255, 99.4 / 255, 99.6 / 255, 1.0, 1.7])
    assert to_8_bit(values).tolist() == [0, 0, 0, 1, 99, 100, 255, 255]


def test_frames_are_never_those_of_the_training() -> None:
    long = Split(tuple(range(500, 2500)), tuple(range(2500, 3000)))
    assert PROTOCOLS["hypergaussians"].frames(3000, long) == long.test
    assert PROTOCOLS["insta350"].frames(3000, long) == tuple(range(2650, 3000))
    short = Split(tuple(range(800)), tuple(range(800, 1000)))
    assert PROTOCOLS["insta350"].frames(1000, short) == short.test
    tiny = Split((0,), (1,))
    assert PROTOCOLS["insta350"].frames(2, tiny) == (1,)


def test_unknown_protocols_are_refused_and_repeated_ones_run_once() -> None:
    assert [protocol.name for protocol in choose_protocols(None)] == ["hypergaussians", "flashavatar", "insta350"]
    assert [protocol.name for protocol in choose_protocols(["insta350", "insta350"])] == ["insta350"]
    with pytest.raises(UserError, match="no protocol 'hyper'; choose from hypergaussians, flashavatar, insta350"):
        choose_protocols(["hyper"])
