"""Splatters that draw on a GPU, as the benchmark draws the others: ours, and gsplat where it is installed."""

from __future__ import annotations

from importlib.util import find_spec

import torch

from avatar.compute.device import CPU, interpreted
from avatar.pipeline.choose_device import sees_gpu
from avatar.types import Camera, Gaussians, Rendering

ON_GPU = ("gpu", "gsplat")


def gpu_backends() -> tuple[str, ...]:
    """Those that can draw here."""
    if not (torch.cuda.is_available() and sees_gpu()):
        return ()
    return ("gpu", "gsplat") if find_spec("gsplat") else ("gpu",)


def device_of(backend: str) -> torch.device:
    return torch.device("cuda") if backend in ON_GPU and not interpreted() else CPU


def settle(device: torch.device) -> None:
    """Wait until a GPU has done what it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def splat_gsplat(gaussians: Gaussians, camera: Camera) -> Rendering:
    """By gsplat (Ye et al., 2024), over black, with its own cut-offs; its ellipses end where ours do, or before."""
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]  # nobody has to have it

    device = gaussians.means.device
    view = torch.eye(4)
    view[:3, :3], view[:3, 3] = camera.R_cam_world, camera.t_cam_world
    intrinsics = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    image, alpha, _ = rasterization(
        *gaussians,
        view[None].to(device),
        intrinsics[None].to(device),
        camera.width,
        camera.height,
        sh_degree=round(gaussians.sh.shape[1] ** 0.5) - 1,
        packed=False,
    )
    return Rendering(image[0], alpha[0, ..., 0])
