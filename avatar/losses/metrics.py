"""PSNR and SSIM of images in [0, 1], over the frame or as a weighted mean over a mask.

Conventions, which published figures differ in:
PSNR  10 log10(1 / mean square error), data range 1, the mean over pixels and channels together; no clamping here.
SSIM  Wang et al. 2004: 11 x 11 Gaussian window with sigma 1.5, K1 = 0.01, K2 = 0.03, population covariance, the mean of
      the three channels. Only windows that lie wholly inside the image count, so nothing depends on a padding: the
      same figure as scikit-image's `structural_similarity(gaussian_weights=True, sigma=1.5,
      use_sample_covariance=False, data_range=1)`. Codes that pad, by reflection (torchmetrics) or with zeros (3D
      Gaussian Splatting), and average the whole frame differ by what the windows within five pixels of a border add.
Masks are weights in [0, 1]; a masked figure is the weighted mean of the squared error or of the SSIM map over the mask
      alone, NOT over the frame, so it does not rise as the mask shrinks.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Shaped
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor

from avatar.tensors import check_shapes

SSIM_WINDOW = 11
SSIM_RADIUS = SSIM_WINDOW // 2
_INSIDE = slice(SSIM_RADIUS, -SSIM_RADIUS)


def psnr(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in dB; over `mask` when one is given.

    Infinite for equal images, NaN for a mask without a pixel. Raises ValueError for sizes that disagree.
    """
    check_shapes(image=(image, "H W 3"), target=(target, "H W 3"), **({} if mask is None else {"mask": (mask, "H W")}))
    return -10.0 * torch.log10(weighted_mean(squared_error(image, target), mask))


def squared_error(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Squared error of each pixel, the mean of its channels, in float64."""
    return (image.double() - target.double()).square().mean(dim=-1)


def ssim(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Structural similarity in [-1, 1]; over the windows centred on `mask` when one is given, NaN when there is none.

    Raises ValueError for sizes that disagree or are under 11 pixels.
    """
    check_shapes(image=(image, "H W 3"), target=(target, "H W 3"), **({} if mask is None else {"mask": (mask, "H W")}))
    if mask is not None:  # windows centred on the mask's bounding box, with a radius on either side
        box = bounding_box(mask)
        if box is None:
            return torch.tensor(torch.nan, dtype=torch.float64)
        crop = tuple(slice(max(side.start - 2 * SSIM_RADIUS, 0), side.stop + 2 * SSIM_RADIUS) for side in box)
        image, target, mask = image[crop], target[crop], mask[crop][_INSIDE, _INSIDE]
    # float64: the variance is a difference of two nearly equal numbers, and a figure has to agree with other programs
    return weighted_mean(ssim_map(image.double(), target.double()).mean(dim=-1), mask)


def ssim_map(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, "H-10 W-10 3"]:
    """SSIM of each window inside the image, by channel; element [i, j] is centred on pixel [i + 5, j + 5].

    Differentiable, in the images' dtype. Raises ValueError for an image under 11 pixels.
    """
    sizes = check_shapes(image=(image, "H W 3"), target=(target, "H W 3"))
    if min(sizes["H"], sizes["W"]) < SSIM_WINDOW:
        raise ValueError(
            f"SSIM needs images of at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, got {sizes['W']} x {sizes['H']}"
        )
    first, second = (tensor.permute(2, 0, 1).unsqueeze(0) for tensor in (image, target))
    return kornia_ssim(first, second, SSIM_WINDOW, eps=0.0, padding="valid")[0].permute(1, 2, 0)


def bounding_box(mask: Shaped[Tensor, "H W"]) -> tuple[slice, slice] | None:
    """Rows and columns that hold every non-zero value of `mask`; None when there is none."""
    rows = mask.any(dim=1).nonzero()
    if len(rows) == 0:
        return None
    columns = mask.any(dim=0).nonzero()
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def grown_box(
    box: tuple[slice, slice], shape: tuple[int, int], *, margin: int = 0, least: int = 0
) -> tuple[slice, slice]:
    """A box with `margin` pixels more on every side, then each side grown about its middle to `least` pixels.

    Inside an image of `shape` (rows, columns), which a box never leaves; a side is shorter only where the image is.
    """
    sides = []
    for side, size in zip(box, shape, strict=True):
        start, stop = max(side.start - margin, 0), min(side.stop + margin, size)
        if stop - start < least:
            length = min(least, size)
            start = min(max((start + stop - length) // 2, 0), size - length)
            stop = start + length
        sides.append(slice(start, stop))
    return sides[0], sides[1]


def weighted_mean(values: Float[Tensor, "H W"], mask: Shaped[Tensor, "H W"] | None) -> Float[Tensor, ""]:
    """Mean over the mask's weights, over all for None; NaN for a mask of zeros."""
    if mask is None:
        return values.mean()
    weight = mask.to(values)
    return (values * weight).sum() / weight.sum()
