"""What this installation can do, what is missing, and how to get it."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path

import torch

import avatar
from avatar.compute.choose import check_gpu, describe_gpu
from avatar.config import config_dir
from avatar.errors import UserError
from avatar.files.places import named_path
from avatar.files.third_party import TRACKING_FILES, require
from avatar.head.assets import load_head_assets
from avatar.losses.lpips import load_lpips
from avatar.runs.trained import HEAD_VARIABLE
from avatar.splat import splat
from avatar.types import Camera, Gaussians


def diagnose(say: Callable[[str], None] = print) -> int:
    """Print one line per finding. Returns 1 when something that every command needs does not work, else 0."""
    say(f"avatar {avatar.__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}")
    say(f"torch {torch.__version__}, {torch.get_num_threads()} threads, {os.cpu_count()} processors")
    works = [
        try_finding("compiled core", draw_one_splat, say),
        try_finding("configuration", lambda: str(config_dir()), say),
    ]
    try_finding("video encoder", find_encoder, say)
    try_finding("GPU", find_gpu, say)
    try_finding("head model", find_default_head, say)
    for file in TRACKING_FILES:
        try_finding(Path(file.name).stem[:16], lambda file=file: f"found ({require(file)})", say)
    try_finding("MediaPipe", find_mediapipe, say)
    for net in ("vgg", "alex", "squeeze"):
        try_finding(f"LPIPS {net}", lambda net=net: f"weights found ({type(load_lpips(net)).__name__})", say)
    return 0 if all(works) else 1


def try_finding(name: str, finding: Callable[[], str], say: Callable[[str], None]) -> bool:
    """Say what `finding` returns or why it failed; every failure is a line, never a stack trace."""
    try:
        say(f"  {name:16} {finding()}")
        return True
    except (UserError, OSError, ImportError, RuntimeError, ValueError) as error:
        say(f"  {name:16} {error}")
        return False


def draw_one_splat() -> str:
    camera = Camera(torch.eye(3), torch.zeros(3), 8.0, 8.0, 4.0, 4.0, 8, 8)
    one = Gaussians(
        torch.tensor([[0.0, 0.0, 1.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.full((1, 3), 0.2),
        torch.tensor([0.9]),
        torch.zeros(1, 1, 3),
    )
    alpha = float(splat(one, camera, torch.zeros(3)).alpha[4, 4])
    if not 0.8 < alpha < 0.9:
        raise RuntimeError(
            f"drew a splat of opacity 0.9 with alpha {alpha:.3f}; the compiled core is broken, reinstall it"
        )
    return f"draws ({Path(sys.modules['avatar._core'].__file__ or '').name})"


def find_encoder() -> str:
    import imageio_ffmpeg

    return f"ffmpeg {imageio_ffmpeg.get_ffmpeg_version()}"


def find_mediapipe() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("mediapipe")
    except PackageNotFoundError:
        return "not installed, so videos cannot be tracked: pip install 'hyperavatar[track]'"


def find_gpu() -> str:
    device = torch.device("cuda", 0)
    check_gpu(device)
    return f"{describe_gpu(device)}: computes what the CPU does"


def find_default_head() -> str:
    named = named_path(HEAD_VARIABLE)
    if not named:
        return f"{HEAD_VARIABLE} is not set; give --head, or put head_model/ into the subject"
    assets = load_head_assets(named)
    return f"{named}: {assets.num_vertices} vertices, {assets.num_expressions} expressions"
