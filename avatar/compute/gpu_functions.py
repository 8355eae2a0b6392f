"""The one way from the rest of the program to its GPU functions, by what they do.

They are imported when they are first called: they import Triton, which takes a second and is not on every machine.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

GPU_FUNCTIONS = {
    "pose a head": "avatar.head.pose_gpu.pose_gpu",
    "make Gaussians": "avatar.gaussians.fused_gaussians_gpu.fused_gaussians_gpu",
    "splat": "avatar.splat.gpu.splat_gpu",
    "upload a camera's pose": "avatar.splat.gpu.pose_on",
    "Adam": "avatar.train.adam_gpu.GpuAdam",
    "Huber loss": "avatar.losses.gpu.huber_gpu",
    "D-SSIM": "avatar.losses.gpu.dssim_gpu",
}


def gpu_function(what: str) -> Callable[..., Any]:
    module, _, name = GPU_FUNCTIONS[what].rpartition(".")
    return getattr(import_module(module), name)
