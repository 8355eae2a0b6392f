"""Which device is taken, and the sentence for each way in which a GPU can be missing."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from avatar.commands.doctor import find_gpu
from avatar.errors import UserError
from avatar.pipeline import choose_device as choose
from avatar.pipeline import self_test
from avatar.pipeline.choose_device import NoGpu, check_gpu, choose_device, sees_gpu
from avatar.pipeline.self_test import WrongGpu

CUDA = torch.device("cuda", 0)


def raising(error: BaseException) -> Callable[..., object]:
    def function(*_: object) -> object:
        raise error

    return function


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """A machine that has two GPUs, as far as anybody asks; a test takes something away from it."""
    properties = SimpleNamespace(name="NVIDIA Pretend", total_memory=24 * 2**30)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: (9, 0))
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: properties)
    monkeypatch.setattr(torch.cuda, "set_device", lambda _: None)
    monkeypatch.setattr(choose, "version", lambda _: "3.7.1")
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(self_test, "self_test", lambda _: {})
    flags = torch.backends.cudnn, torch.backends.cuda.matmul
    before = flags[0].deterministic, flags[0].benchmark, flags[0].allow_tf32, flags[1].allow_tf32
    check_gpu.cache_clear()
    yield monkeypatch
    check_gpu.cache_clear()
    flags[0].deterministic, flags[0].benchmark, flags[0].allow_tf32, flags[1].allow_tf32 = before


def lacks_cuda(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(torch.version, "cuda", None)
    patch.setattr(torch.version, "hip", None)


def lacks_driver(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(torch.cuda, "is_available", lambda: False)
    patch.setattr(torch.cuda, "init", raising(RuntimeError("Found no NVIDIA driver on your system.\nmore")))


def lacks_devices(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(torch.cuda, "is_available", lambda: False)
    patch.setattr(torch.cuda, "init", lambda: None)


def lacks_compiler(patch: pytest.MonkeyPatch) -> None:
    patch.delenv("CC", raising=False)
    patch.setattr(shutil, "which", lambda _: None)


def attribute(owner: object, name: str, value: object) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setattr(owner, name, value)


NO_COMPILER = subprocess.CalledProcessError(1, ["gcc"])
MISSING: dict[str, tuple[Callable[[pytest.MonkeyPatch], None], str]] = {
    "CPU-only torch": (lacks_cuda, r"torch \S+ is a build for CPUs; .* pip install '\.\[gpu\]'"),
    "no driver": (lacks_driver, r"finds no GPU \(Found no NVIDIA driver on your system\.\): .* nvidia-smi"),
    "no device": (lacks_devices, r"finds no GPU \(no device\)"),
    "too old": (
        attribute(torch.cuda, "get_device_capability", lambda _: (7, 5)),
        r"cuda:0, NVIDIA Pretend with 24 GiB is too old: it has compute capability 7\.5, the kernels need 8\.0",
    ),
    "no Triton": (attribute(choose, "version", raising(PackageNotFoundError())), r"not installed: pip install"),
    "an old Triton": (
        attribute(choose, "version", lambda _: "3.5.1+git1"),
        r"Triton 3\.5\.1\+git1 is older than 3\.6\.0",
    ),
    "no compiler": (lacks_compiler, r"needs a C compiler .*apt install gcc.* or name one with CC"),
    "no memory": (
        attribute(self_test, "self_test", raising(torch.OutOfMemoryError("CUDA out of memory"))),
        r"cuda:0, NVIDIA Pretend with 24 GiB has no memory left for a test",
    ),
    "kernels that do not run": (
        attribute(self_test, "self_test", raising(RuntimeError("illegal instruction\nat line 5"))),
        r"do not run on cuda:0, .* \(illegal instruction\); torch \S+, Triton 3\.7\.1: use --device cpu",
    ),
    "a compiler that fails": (attribute(self_test, "self_test", raising(NO_COMPILER)), r"do not run on .* \(Command "),
    "an error without words": (attribute(self_test, "self_test", raising(OSError())), r"\(OSError\)"),
}


@pytest.mark.parametrize("name", MISSING)
def test_each_way_in_which_a_gpu_can_be_missing_has_its_sentence(name: str, gpu: pytest.MonkeyPatch) -> None:
    take_away, sentence = MISSING[name]
    take_away(gpu)
    said: list[str] = []
    with pytest.raises(NoGpu, match=sentence) as caught:
        choose_device("cuda", said.append)
    assert "\n" not in str(caught.value) and not said
    with pytest.raises(NoGpu, match=sentence):
        find_gpu()
    # A machine with a GPU that cannot be used: auto goes on without it, and says so.
    gpu.setattr(choose, "sees_gpu", lambda: True)
    assert choose_device("auto", said.append) == torch.device("cpu")
    assert said == [f"Working on the CPU: {caught.value}"]


def test_a_gpu_that_is_there_is_taken_and_named(gpu: pytest.MonkeyPatch) -> None:
    torch.backends.cudnn.deterministic, torch.backends.cudnn.allow_tf32 = False, True
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.benchmark = True
    said: list[str] = []
    assert choose_device("auto", said.append) == CUDA
    assert choose_device("cuda", said.append) == CUDA
    assert choose_device("cuda:1", said.append) == torch.device("cuda", 1)
    assert said == [f"Working on cuda:{i}, NVIDIA Pretend with 24 GiB" for i in (0, 0, 1)]
    cudnn = torch.backends.cudnn
    assert (cudnn.deterministic, cudnn.benchmark, cudnn.allow_tf32) == (True, False, False)
    assert not torch.backends.cuda.matmul.allow_tf32
    assert find_gpu() == "cuda:0, NVIDIA Pretend with 24 GiB: computes what the CPU does"


def test_a_gpu_beyond_the_last_is_refused(gpu: pytest.MonkeyPatch) -> None:
    with pytest.raises(NoGpu, match="there is no cuda:2: torch sees 2 GPUs, the first is cuda:0"):
        choose_device("cuda:2", print)


@pytest.mark.parametrize("name", ["auto", "cuda"])
def test_a_gpu_that_computes_something_else_stops_the_program(name: str, gpu: pytest.MonkeyPatch) -> None:
    """Never silently, and not by going on elsewhere either: such a machine has to be looked at."""
    gpu.setattr(self_test, "self_test", raising(WrongGpu("gives wrong numbers")))
    with pytest.raises(WrongGpu):
        choose_device(name, print)


def test_the_self_test_runs_once_for_each_gpu(gpu: pytest.MonkeyPatch) -> None:
    tested: list[torch.device] = []
    gpu.setattr(self_test, "self_test", tested.append)
    for name in ("cuda", "auto", "cuda:1", "cuda:0"):
        choose_device(name, lambda _: None)
    assert tested == [CUDA, torch.device("cuda", 1)]


def test_amds_devices_are_not_asked_for_nvidias_age(gpu: pytest.MonkeyPatch) -> None:
    gpu.setattr(torch.version, "cuda", None)
    gpu.setattr(torch.version, "hip", "7.0")
    gpu.setattr(torch.cuda, "get_device_capability", lambda _: (0, 0))
    assert choose_device("cuda", lambda _: None) == CUDA


def test_a_compiler_that_is_named_is_enough(gpu: pytest.MonkeyPatch) -> None:
    lacks_compiler(gpu)
    gpu.setenv("CC", "my-cc")
    assert choose_device("cuda", lambda _: None) == CUDA


def test_without_a_gpu_auto_works_on_the_cpu_and_says_nothing(gpu: pytest.MonkeyPatch) -> None:
    gpu.setattr(choose, "sees_gpu", lambda: False)
    gpu.setattr(choose, "check_gpu", raising(AssertionError("nobody should ask")))
    said: list[str] = []
    assert choose_device("auto", said.append) == choose_device("cpu", said.append) == torch.device("cpu")
    assert said == []


def test_a_gpu_is_seen_by_torch_or_by_its_device_file(monkeypatch: pytest.MonkeyPatch) -> None:
    files: set[str] = set()
    monkeypatch.setattr(Path, "exists", lambda path: os.fspath(path) in files)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert not sees_gpu()
    for name in ("/dev/nvidiactl", "/dev/kfd", "/usr/lib/wsl/lib/libcuda.so.1"):
        files.add(name)
        assert sees_gpu()
        files.clear()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert sees_gpu()


@pytest.mark.parametrize("name", ["gpu", "CPU", "cuda:", "cuda:-1", "cuda:1000", "mps", "", "cuda:0 "])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(UserError, match="is not one of auto, cpu, cuda, cuda:N"):
        choose_device(name, print)
