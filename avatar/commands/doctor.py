"""What this installation can do, what is missing, and how to get it: a table, made without importing PyTorch."""

from __future__ import annotations

import platform
from argparse import Namespace
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

from avatar.compute.availability import has_gpu_driver
from avatar.compute.processors import processor_count
from avatar.config_values import config_dir
from avatar.errors import UserError, install
from avatar.files.environment import named_path
from avatar.files.third_party import (
    FETCHED_LPIPS,
    HEAD_VARIABLE,
    TRACKING_FILES,
    find,
    has_lpips,
    is_published,
    lpips_place,
)
from avatar.head.find_head_model import find_model_file
from avatar.version import __version__

EXTRAS = {
    "mediapipe": ("track", "track videos"),
    "viser": ("view", "avatar view"),
    "matplotlib": ("plots", "curves, reports"),
}


class Finding(NamedTuple):
    name: str
    state: str
    advice: str = ""
    is_broken: bool = False  # and every command needs it


def run_doctor(_: Namespace) -> int:
    """Print the table of findings. Returns 1 when something that every command needs does not work, else 0."""
    found = [*essentials(), gpu(), head_model(), models(), *map(package, EXTRAS)]
    system = f"{platform.system()} {platform.machine()}, {processor_count()} processors"
    print(f"avatar {__version__}, Python {platform.python_version()}, {system}\n")
    for line in table(found):
        print(line)
    return 1 if any(finding.is_broken for finding in found) else 0


def table(found: list[Finding]) -> Iterator[str]:
    rows = [("name", "state", "what to do"), *((f.name, f.state, f.advice) for f in found)]
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    for name, state, advice in rows:
        yield f"{name:{widths[0]}}  {state:{widths[1]}}  {advice}".rstrip()


def essentials() -> Iterator[Finding]:
    for name, find_out, advice in (
        ("PyTorch", lambda: version("torch"), "install the program again"),
        ("compiled core", draw_one_triangle, "install the program again"),
        ("configuration", lambda: "found" if config_dir() else "", "install the program again"),
        ("video encoder", find_encoder, "pip install imageio-ffmpeg"),
    ):
        try:
            yield Finding(name, find_out())
        except (UserError, PackageNotFoundError, OSError, ImportError, RuntimeError, ValueError) as error:
            yield Finding(name, "broken", f"{advice} ({error})", is_broken=name != "video encoder")


def draw_one_triangle() -> str:
    import numpy as np

    from avatar.head.rasterize import rasterize_mesh

    corners = np.array([[0, 0, 1], [8, 0, 1], [0, 8, 1]], np.float32)
    raster = rasterize_mesh(corners, np.array([[0, 1, 2]]), 8, 8)
    if raster.face_id[1, 1] != 0 or raster.face_id[7, 7] != -1:
        raise RuntimeError("it draws a triangle wrongly")
    return "works"


def find_encoder() -> str:
    import imageio_ffmpeg

    return f"ffmpeg {imageio_ffmpeg.get_ffmpeg_version().partition('-')[0]}"


def gpu() -> Finding:
    """Tested only where there is a driver: that takes PyTorch and some seconds."""
    if not has_gpu_driver():
        return Finding("GPU", "none", "nothing: training takes the processor")
    try:
        return Finding("GPU", find_gpu())
    except (UserError, OSError, ImportError, RuntimeError, ValueError) as error:
        return Finding("GPU", "not used", str(error))


def find_gpu() -> str:
    import torch

    from avatar.pipeline.choose_device import check_gpu, describe_gpu

    device = torch.device("cuda", 0)
    check_gpu(device)
    return f"{describe_gpu(device)}: computes what the CPU does"


def head_model() -> Finding:
    try:
        path = named_path(HEAD_VARIABLE)
    except UserError as error:
        return Finding("head model", "missing", str(error))
    if path is None:
        return Finding(
            "head model", "not set", f"give --head, set {HEAD_VARIABLE}, or put head_model/ into the subject"
        )
    try:
        find_model_file(path)
    except (UserError, OSError) as error:
        return Finding("head model", "missing", f"{HEAD_VARIABLE}: {error}")
    return Finding("head model", "found")


def models() -> Finding:
    """Those that the program uses by default. Whether weights of LPIPS are whole is not found out, which takes PyTorch."""
    needed = [file for file in TRACKING_FILES if not file.is_optional]
    there = [(path := find(file)) is not None and is_published(file, path) for file in needed]
    there += [has_lpips(lpips_place(net), net) for net in FETCHED_LPIPS]
    return Finding("models", f"{sum(there)} of {len(there)} there", "avatar models lists them and the optional ones")


def package(name: str) -> Finding:
    extra, purpose = EXTRAS[name]
    try:
        return Finding(name, version(name))
    except PackageNotFoundError:
        return Finding(name, "missing", f"{purpose}: {install(extra)}")
