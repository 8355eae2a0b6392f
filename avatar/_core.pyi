"""The compiled module. Private: the Python functions that call it check the arguments and document them."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

def environment(name: str) -> str | None: ...
def rasterize_mesh(
    screen: np.ndarray, faces: np.ndarray, face_id: np.ndarray, barycentric: np.ndarray, depth: np.ndarray
) -> None: ...

class Drawing:
    """What the backward pass needs of a forward pass."""

def splat_forward(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    rotation: Sequence[float],
    translation: Sequence[float],
    intrinsics: Sequence[float],  # fx, fy, cx, cy
    sh_degree: int,
    cutoffs: Sequence[float],  # alpha_min, alpha_max, t_min
    blur: float,
    near: float,
    antialiased: bool,
    region: Sequence[int],  # left, top, right, bottom
    simd: str,
    threads: int,
    image: Tensor,
    alpha: Tensor,
    everywhere: bool = False,  # for tests: look for every splat at every pixel
) -> Drawing | None: ...
def splat_backward(
    drawing: Drawing,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    grad_image: Tensor | None,
    grad_alpha: Tensor | None,
    grad_means: Tensor,
    grad_quats: Tensor,
    grad_scales: Tensor,
    grad_opacities: Tensor,
    grad_sh: Tensor,
    grad_background: Tensor,
    grad_pose: Tensor | None = None,
) -> None: ...
def dssim(image: Tensor, target: Tensor, mask: Tensor, simd: str, threads: int, gradient: Tensor | None) -> float: ...
def hyper_forward(
    packed: Tensor,
    latents: Tensor,
    simd: str,
    threads: int,
    offsets: Tensor,
    solved: Tensor | None,
) -> None: ...
def hyper_backward(
    packed: Tensor,
    latents: Tensor,
    solved: Tensor,
    grad_offsets: Tensor,
    simd: str,
    threads: int,
    with_parameters: bool,
    grad_latents: Tensor | None,
) -> Tensor | None: ...  # the gradient of the parameters, a large_tensor
def large_tensor(shape: Sequence[int]) -> Tensor: ...  # uninitialised
def hyper_apply(matrix: Tensor, bias: Tensor, latents: Tensor, simd: str, threads: int, offsets: Tensor) -> None: ...
def interpolate_forward(grid: Tensor, cells: Tensor, weights: Tensor, simd: str, threads: int, out: Tensor) -> None: ...
def interpolate_backward(
    grad: Tensor, begins: Tensor, gaussians: Tensor, weights: Tensor, simd: str, threads: int, grad_grid: Tensor
) -> None: ...
def apply_offsets_forward(
    points: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    raw: Tensor,
    simd: str,
    threads: int,
    means: Tensor,
    out_quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
) -> None: ...
def apply_offsets_backward(
    quats: Tensor,
    log_scales: Tensor,
    raw: Tensor,
    scales: Tensor,
    opacities: Tensor,
    by_means: Tensor,
    by_quats: Tensor,
    by_scales: Tensor,
    by_opacities: Tensor,
    simd: str,
    threads: int,
    grad_quats: Tensor,
    grad_log_scales: Tensor,
    grad_opacity_logits: Tensor,
    grad_raw: Tensor,
) -> None: ...
