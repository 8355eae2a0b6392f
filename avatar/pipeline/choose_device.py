"""Which device a command works on: a GPU that has shown that it computes what the CPU does, or the CPU, and why."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from importlib.metadata import PackageNotFoundError, version

import torch

from avatar.compute.availability import has_gpu_driver
from avatar.compute.device import CPU
from avatar.config_values import check_device
from avatar.errors import UserError, install

LEAST_TRITON = (3, 6, 0)  # the oldest that the kernels have run with
LEAST_CAPABILITY = (8, 0)  # of NVIDIA's devices: the oldest that the kernels are compiled for
INSTALL = install("gpu")


class NoGpu(UserError):
    """Why no GPU, or not this one, can be used."""


def choose_device(name: str, say: Callable[[str], None]) -> torch.device:
    """The device of "auto", "cpu", "cuda" or "cuda:N".

    "auto" takes the first GPU, if there is one that passes `check_gpu`, and says which; where there is one that does not,
    it says why. A GPU that is asked for by name is used or refused: UserError.
    """
    check_device(name)
    if name == "cpu":
        return CPU
    if name == "auto":
        if not sees_gpu():
            return CPU
        try:
            return _ready(torch.device("cuda", 0), say)
        except NoGpu as error:
            say(f"Working on the CPU: {error}")
            return CPU
    return _ready(torch.device("cuda", int(name.partition(":")[2] or 0)), say)


def _ready(device: torch.device, say: Callable[[str], None]) -> torch.device:
    check_gpu(device)
    # The same bits every time, and of float32: cuDNN's fastest convolutions add up in any order and round to 10 bits.
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    torch.cuda.set_device(device)
    say(f"Working on {describe_gpu(device)}")
    return device


def sees_gpu() -> bool:
    """Whether this machine has a GPU, be it one that torch cannot use."""
    return torch.cuda.is_available() or has_gpu_driver()


def describe_gpu(device: torch.device) -> str:
    properties = torch.cuda.get_device_properties(device)
    return f"{device}, {properties.name} with {properties.total_memory / 2**30:.0f} GiB"


@cache  # once in a process
def check_gpu(device: torch.device) -> None:
    """Raise NoGpu, saying what to do, unless the kernels run on the GPU and compute what the CPU does."""
    if torch.version.cuda is None and torch.version.hip is None:
        raise NoGpu(
            f"torch {torch.__version__} is a build for CPUs; install one for your GPU (https://pytorch.org/get-started) "
            f"and then {INSTALL}"
        )
    _check_driver(device)
    _check_age(device)
    _check_triton()
    _check_compiler()
    from avatar.pipeline.self_test import self_test

    try:
        self_test(device)
    except torch.OutOfMemoryError:
        raise NoGpu(f"{describe_gpu(device)} has no memory left for a test; other programs fill it") from None
    except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise NoGpu(
            f"the kernels do not run on {describe_gpu(device)} ({reason}); torch {torch.__version__}, Triton "
            f"{version('triton')}: use --device cpu, and report this"
        ) from error


def _check_driver(device: torch.device) -> None:
    if not torch.cuda.is_available():
        try:
            torch.cuda.init()
            reason = "no device"
        except (RuntimeError, AssertionError) as error:
            reason = str(error).strip().splitlines()[0]
        raise NoGpu(
            f"torch {torch.__version__} finds no GPU ({reason}): there is none, or its driver is missing or too old; "
            "nvidia-smi or rocminfo tell more"
        )
    count = torch.cuda.device_count()
    if device.index is not None and device.index >= count:
        raise NoGpu(f"there is no {device}: torch sees {count} GPU{'s' if count > 1 else ''}, the first is cuda:0")


def _check_age(device: torch.device) -> None:
    if torch.version.cuda is None:
        return
    capability = torch.cuda.get_device_capability(device)
    if capability < LEAST_CAPABILITY:
        raise NoGpu(
            f"{describe_gpu(device)} is too old: it has compute capability {capability[0]}.{capability[1]}, the kernels "
            f"need {LEAST_CAPABILITY[0]}.{LEAST_CAPABILITY[1]} (Ampere) or newer"
        )


def _check_triton() -> None:
    try:
        found = version("triton")
    except PackageNotFoundError:
        raise NoGpu(f"Triton, which the kernels are written in, is not installed: {INSTALL}") from None
    if tuple(int(part) for part in found.split("+")[0].split(".")[:3] if part.isdigit()) < LEAST_TRITON:
        wanted = ".".join(map(str, LEAST_TRITON))
        raise NoGpu(
            f"Triton {found} is older than {wanted}, the oldest that the kernels have run with; it comes with torch 2.11: "
            f"install that or a newer one, and then {INSTALL}"
        )


def _check_compiler() -> None:
    """Triton builds its launcher with a C compiler at its first use."""
    if os.environ.get("CC") is None and not any(map(shutil.which, ("gcc", "clang", "cc"))):
        raise NoGpu("Triton needs a C compiler at its first use (Debian: apt install gcc); or name one with CC")
