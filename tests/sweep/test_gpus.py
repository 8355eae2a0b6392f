"""Which job is given which GPU, on machines that have as many as a test says."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from avatar.compute.device import visible_gpus
from avatar.errors import UserError
from avatar.sweep import engines
from avatar.sweep.engines import EngineOptions, LocalProcesses, gpu_places, make_engine
from avatar.sweep.spec import Job, Resources, Spec, read_spec


def spec_of(*devices: str, gpus: float | None = None) -> Spec:
    words = [(f"device={device}",) if device else () for device in devices]
    jobs = tuple(Job(f"j{i}", "s", "v", i, {"folder": "f"}, own, ()) for i, own in enumerate(words))
    return Spec(jobs, Resources(threads=1, memory_gb=0.1, gpus=gpus), retries=0)


class Worker:
    """One that ends when it is told to."""

    said: str | None = None

    def poll(self) -> str | None:
        return self.said


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[Worker, str]]:
    """What runs, by its folder: the worker, and the GPUs that it was shown."""
    found: dict[str, tuple[Worker, str]] = {}

    def start(folder: Path, threads: int, gpus: str | None = None) -> Worker:
        assert gpus is not None
        found[folder.name] = Worker(), gpus
        return found[folder.name][0]

    monkeypatch.setattr(engines, "Worker", start)
    monkeypatch.setattr(engines, "workers_that_fit", lambda _: 8)
    return found


def local(monkeypatch: pytest.MonkeyPatch, names: list[str], spec: Spec, workers: int | None = None) -> LocalProcesses:
    monkeypatch.setattr(engines, "visible_gpus", lambda: names)
    engine = make_engine("local", spec, Path(), EngineOptions(workers))
    assert isinstance(engine, LocalProcesses)
    return engine


def test_every_job_has_a_gpu_of_its_own_and_the_next_one_takes_its_place(
    monkeypatch: pytest.MonkeyPatch, started: dict[str, tuple[Worker, str]]
) -> None:
    engine = local(monkeypatch, ["0", "1"], spec_of("", "", "", ""))
    assert engine.workers == 2
    engine.submit([Path(name) for name in "abcd"])
    assert {name: gpus for name, (_, gpus) in started.items()} == {"a": "0", "b": "1"}
    assert engine.poll(Path("a")) is None
    started["b"][0].said = ""
    assert engine.poll(Path("b")) == ""
    assert started["c"][1] == "1" and "d" not in started
    started["a"][0].said = ""
    engine.poll(Path("a"))
    assert started["d"][1] == "0"


def test_parts_share_a_gpu_in_turns_and_workers_are_no_more_than_asked_for(
    monkeypatch: pytest.MonkeyPatch, started: dict[str, tuple[Worker, str]]
) -> None:
    engine = local(monkeypatch, ["3", "5"], spec_of("", gpus=0.5), workers=3)
    engine.submit([Path(name) for name in "abcde"])
    assert [gpus for _, gpus in started.values()] == ["3", "5", "3"]
    assert gpu_places(["0", "1", "2"], 0.34) == ["0", "1", "2", "0", "1", "2"]
    assert gpu_places(["0"], 0.2) == ["0"] * 5


def test_more_than_one_gpu_is_a_group(monkeypatch: pytest.MonkeyPatch) -> None:
    assert gpu_places(["0", "1", "2", "3", "4"], 2) == ["0,1", "2,3"]
    with pytest.raises(UserError, match="takes 3 GPUs, and this machine has 2"):
        local(monkeypatch, ["0", "1"], spec_of("", gpus=3))


@pytest.mark.parametrize(
    ("names", "spec"), [([], spec_of("", "")), (["0"], spec_of("cpu", "cpu")), (["0"], spec_of("", gpus=0))]
)
def test_jobs_without_a_gpu_see_none_and_run_by_cores(
    monkeypatch: pytest.MonkeyPatch, started: dict[str, tuple[Worker, str]], names: list[str], spec: Spec
) -> None:
    engine = local(monkeypatch, names, spec)
    assert engine.workers == 8
    engine.submit([Path("a"), Path("b")])
    assert [gpus for _, gpus in started.values()] == ["", ""]


@pytest.mark.parametrize(("threads", "memory_gb", "jobs"), [(1, 0.1, 8), (3, 0.1, 2), (1, 2.5, 4), (9, 11.0, 1)])
def test_cores_and_memory_bound_the_jobs_at_a_time(
    monkeypatch: pytest.MonkeyPatch, threads: int, memory_gb: float, jobs: int
) -> None:
    monkeypatch.setattr(engines, "processor_count", lambda: 8)
    monkeypatch.setattr(engines, "available_bytes", lambda: 10 * 2**30)
    assert engines.workers_that_fit(Resources(threads, memory_gb)) == jobs


def test_a_cluster_gives_gpus_to_those_that_ask_by_name() -> None:
    assert spec_of("", "cpu").gpus_of_a_job(False) == 0
    assert spec_of("", "cuda").gpus_of_a_job(False) == 1
    assert spec_of("", gpus=0.25).gpus_of_a_job(False) == 0.25


def test_ray_is_asked_for_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []

    def remote(**needs: Any) -> Any:
        asked.append(needs)
        return lambda function: function

    fake = SimpleNamespace(init=lambda **_: None, nodes=list, remote=remote, __spec__="")
    monkeypatch.setitem(sys.modules, "ray", fake)  # type: ignore[arg-type]
    make_engine("ray", spec_of("cuda"), Path(), EngineOptions())
    make_engine("ray", spec_of(""), Path(), EngineOptions())
    assert [needs.get("num_gpus") for needs in asked] == [1, None]
    assert [needs["max_retries"] for needs in asked] == [0, 0]  # the sweep decides what is tried again


def test_rays_own_cluster_has_the_processors_of_its_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    """With fewer than one job takes, Ray would wait for ever."""
    begun: list[Any] = []
    asked: list[dict[str, Any]] = []

    def remote(**needs: Any) -> Any:
        asked.append(needs)
        return lambda function: function

    def init(**options: Any) -> None:
        begun.append(options.get("num_cpus"))

    fake = SimpleNamespace(init=init, nodes=list, remote=remote, __spec__="")
    monkeypatch.setitem(sys.modules, "ray", fake)  # type: ignore[arg-type]
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(engines, "workers_that_fit", lambda _: 1)
    for workers, address in ((1, None), (3, None), (None, None), (3, "head:6379")):
        resources = Resources(threads=4, memory_gb=0.1)
        make_engine("ray", replace(spec_of(""), resources=resources), Path(), EngineOptions(workers, address))
    assert begun == [4, 12, 4, None]
    assert ["memory" in needs for needs in asked] == [False, False, False, True]


def test_a_ray_cluster_that_no_job_fits_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ray waits for another machine, and says nothing."""
    has = [{"CPU": 8.0, "memory": 2.0**30}, {"CPU": 1.0, "memory": 2.0**35, "GPU": 1.0}]
    nodes = [{"Alive": True, "Resources": one} for one in has] + [{"Alive": False, "Resources": {"CPU": 9.0}}]
    fake = SimpleNamespace(init=lambda **_: None, nodes=lambda: nodes, remote=lambda **_: lambda f: f, __spec__="")
    monkeypatch.setitem(sys.modules, "ray", fake)  # type: ignore[arg-type]

    def said(threads: int, memory_gb: float, gpus: float) -> str:
        spec = replace(spec_of(""), resources=Resources(threads, memory_gb, gpus))
        make_engine("ray", spec, Path(), EngineOptions(address="head:6379"))
        return capsys.readouterr().out

    assert said(8, 1.0, 0) == said(1, 32.0, 1) == ""
    assert "no machine of the Ray cluster has 8 processors and 2 GB of memory, which a job takes" in said(8, 2.0, 0)
    assert "has 9 processors and 0.5 GB of memory, which" in said(9, 0.5, 0)
    assert "has 2 processors and 0.5 GB of memory and 1 GPUs, which" in said(2, 0.5, 1)


def test_slurm_is_asked_for_whole_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    executor = SimpleNamespace(update_parameters=lambda **parameters: asked.append(parameters))
    fake = SimpleNamespace(AutoExecutor=lambda **_: executor, __spec__="")
    monkeypatch.setitem(sys.modules, "submitit", fake)  # type: ignore[arg-type]
    for spec in (spec_of("cuda"), spec_of("", gpus=0.25), spec_of("")):
        make_engine("slurm", spec, Path(), EngineOptions(address="slurm"))
    assert [parameters["gpus_per_node"] for parameters in asked] == [1, 1, 0]


def test_a_gpu_by_number_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_text("subjects: [a]\noverrides: ['device=cuda:1']\n")
    with pytest.raises(UserError, match="hands out the GPUs itself"):
        read_spec(tmp_path / "sweep.yaml")


def test_gpus_have_the_names_that_this_process_was_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert visible_gpus() == ["0", "1"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4, GPU-8f2c")
    assert visible_gpus() == ["4", "GPU-8f2c"]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert visible_gpus() == []
