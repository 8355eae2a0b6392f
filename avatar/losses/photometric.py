"""The training loss of FlashAvatar and HyperGaussians, as functions of one rendered and one true image.

    loss = huber(image) + 40 * huber(image * mouth_mask) + 0.05 * LPIPS(image * head_mask)

The last term counts from the middle of training (step 15,000 of 30,000). Every mean is over all pixels and channels of
the frame, so the weight of the mouth term grows with the mouth's area. Where there are no LPIPS weights, D-SSIM takes
the place of LPIPS. Source: FlashAvatar; HyperGaussians, section on training.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import on_gpu
from avatar.compute.gpu_functions import gpu_function
from avatar.losses.dssim_cpu import dssim_cpu
from avatar.losses.lpips_network import MIN_SIZE
from avatar.losses.metrics import SSIM_RADIUS, SSIM_WINDOW, bounding_box, grown_box, ssim_map
from avatar.tensors import check_shapes

HUBER_DELTA = 0.1
MOUTH_WEIGHT = 40.0
LPIPS_WEIGHT = 0.05
HEAD_MARGIN = 16  # pixels around the head's box
CROP_SIZES = 8  # of a side, where crops are to have few sizes

# (image [H, W, 3], target [H, W, 3], mask [H, W]) -> a dissimilarity of the two images times the mask, scalar
Perceptual = Callable[..., Tensor]


class PhotometricLoss(NamedTuple):
    """The weighted terms, scalars; `total` is their sum and the one to differentiate."""

    total: Float[Tensor, ""]
    frame: Float[Tensor, ""]
    mouth: Float[Tensor, ""]
    perceptual: Float[Tensor, ""]


def photometric_loss(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    mouth_mask: Float[Tensor, "H W"],
    head_mask: Float[Tensor, "H W"],
    *,
    perceptual: Perceptual | None = None,
    perceptual_weight: float = LPIPS_WEIGHT,
    mouth_weight: float = MOUTH_WEIGHT,
    delta: float = HUBER_DELTA,
) -> PhotometricLoss:
    """The loss of one frame. `perceptual` is None until the step from which that term counts, then `dssim` or
    `masked_lpips(...)` with its weight. Raises ValueError for tensors whose sizes disagree."""
    check_shapes(
        image=(image, "H W 3"), target=(target, "H W 3"), mouth_mask=(mouth_mask, "H W"), head_mask=(head_mask, "H W")
    )
    if _by_gpu_kernels(image, target, mouth_mask):
        frame, mouth = gpu_function("Huber loss")(image, target, mouth_mask, delta=delta, mask_weight=mouth_weight)
    else:
        frame = F.huber_loss(image, target, delta=delta)
        mouth = mouth_weight * masked_huber(image, target, mouth_mask, delta=delta)
    if perceptual is None:
        third = torch.zeros((), dtype=image.dtype, device=image.device)
    else:
        third = perceptual_weight * perceptual(image, target, head_mask)
    return PhotometricLoss(total=frame + mouth + third, frame=frame, mouth=mouth, perceptual=third)


def masked_huber(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"], *, delta: float
) -> Float[Tensor, ""]:
    """Huber loss of `image * mask` against `target * mask`, mean over the WHOLE frame.

    0.5 d^2 for |d| < delta, else delta (|d| - delta / 2). Zero outside the mask's bounding box, so evaluated in it.
    """
    box = bounding_box(mask)
    if box is None:
        return (image * 0.0).sum()  # keeps the graph: a frame whose mouth is hidden has a zero gradient, not none
    weight = mask[box].unsqueeze(-1)
    loss = F.huber_loss(image[box] * weight, target[box] * weight, delta=delta, reduction="sum")
    return loss / image.numel()


def dssim(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """Structural dissimilarity (1 - SSIM) / 2 of `image * mask` against `target * mask`; SSIM as `metrics.ssim`.

    Windows without a masked pixel see two black images and add nothing, so only the others are evaluated. Float32
    tensors that are differentiated by the image alone take a kernel: on the CPU the compiled one, which computes in double
    precision, or a GPU's.
    """
    height, width = mask.shape
    if min(height, width) >= SSIM_WINDOW:
        if _by_gpu_kernels(image, target, mask):
            return gpu_function("D-SSIM")(image, target, mask)
        plain = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in (image, target, mask))
        if plain and not (target.requires_grad or mask.requires_grad):
            return dssim_cpu(image, target, mask)
    box = bounding_box(mask)
    if box is None:
        return (image * 0.0).sum()
    # A window centred up to one radius outside the box touches it, and reads up to two radii outside.
    rows, columns = (slice(max(side.start - 2 * SSIM_RADIUS, 0), side.stop + 2 * SSIM_RADIUS) for side in box)
    weight = mask[rows, columns].unsqueeze(-1)
    similarity = ssim_map(image[rows, columns] * weight, target[rows, columns] * weight)
    windows = (height - 2 * SSIM_RADIUS) * (width - 2 * SSIM_RADIUS)
    return (1.0 - similarity).sum() / (2.0 * similarity.shape[-1] * windows)


def _by_gpu_kernels(image: Tensor, target: Tensor, mask: Tensor) -> bool:
    """Whether a GPU's kernels take these: float32, differentiated by the image alone."""
    plain = all(tensor.dtype == torch.float32 and on_gpu(tensor) for tensor in (image, target, mask))
    return plain and not (target.requires_grad or mask.requires_grad)


def on_head(perceptual: Perceptual, margin: int = HEAD_MARGIN, least: int = MIN_SIZE) -> Perceptual:
    """`perceptual` of the mask's bounding box, grown by `margin` pixels, in place of the whole frame.

    The value is scaled by the box's share of the frame, so it weighs what the mean over the whole frame does: both images
    are black outside the mask. Only networks that see the frame's border where the box ends can tell. A head far away gets
    a box of `least` pixels a side, which LPIPS needs, where the frame has them. A caller that knows the box may name it
    (`Frame.head_box`): to look for it is to wait for a GPU. Or `crop` holds the rows and columns, int64, which a CUDA graph
    reads (`crop_of_few_sizes`).
    """

    def cropped(
        image: Tensor,
        target: Tensor,
        mask: Tensor,
        box: tuple[slice, slice] | None = None,
        crop: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        if crop is not None:
            parts = [part.index_select(0, crop[0]).index_select(1, crop[1]) for part in (image, target, mask)]
        else:
            box = bounding_box(mask) if box is None else box
            if box is None or box[0].start == box[0].stop:
                return (image * 0.0).sum()
            inside = grown_box(box, (mask.shape[0], mask.shape[1]), margin=margin, least=least)
            parts = [part[inside] for part in (image, target, mask)]
        share = parts[2].numel() / mask.numel()
        return share * perceptual(*parts)

    return cropped


def crop_of_few_sizes(box: tuple[slice, slice], shape: tuple[int, int]) -> tuple[slice, slice]:
    """What `on_head` takes of an image of `shape`, or more: each side has one of `CROP_SIZES` lengths."""
    grain = max(-(-max(shape) // CROP_SIZES), MIN_SIZE)
    sides = grown_box(box, shape, margin=HEAD_MARGIN)
    lengths = [-(-(side.stop - side.start) // grain) * grain for side in sides]
    rows, columns = (
        grown_box((side, side), (size, size), least=length)[0]
        for side, size, length in zip(sides, shape, lengths, strict=True)
    )
    return rows, columns


def masked_lpips(lpips: Callable[[Tensor, Tensor], Tensor]) -> Perceptual:
    """The perceptual term of the paper out of an `avatar.losses.lpips.Lpips`: the distance of `image * mask`, unscaled."""

    def distance(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
        weight = mask.unsqueeze(-1)
        return lpips(image * weight, target * weight)

    return distance
