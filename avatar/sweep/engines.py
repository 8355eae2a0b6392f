"""Where a sweep's jobs run: processes of this machine, a Ray cluster, a SLURM cluster. An engine keeps nothing itself."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from avatar.compute.device import visible_gpus
from avatar.compute.memory import available_bytes
from avatar.compute.processors import processor_count
from avatar.errors import UserError, check_installed
from avatar.sweep.spec import Resources, Spec
from avatar.sweep.worker import Worker, work_until_done

RAY_NAMES = {"num_cpus": "CPU", "memory": "memory", "num_gpus": "GPU"}  # what a task asks for -> of a machine
LONGEST_MINUTES = 24 * 60  # of a SLURM job; training goes on in the next one


class Engine(Protocol):
    """Starts workers and tells what became of them."""

    name: str

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        """A handle for each job; the engine queues what it cannot start at once."""
        ...

    def poll(self, handle: Any) -> str | None:
        """None while the worker runs or waits; then its last words, empty when it ended as it should."""
        ...

    def stop(self, handles: Sequence[Any]) -> None:
        """Ask workers to save their state and end; those that do not are ended."""
        ...

    def close(self) -> None:
        """Let go of the cluster."""
        ...


@dataclass(frozen=True)
class EngineOptions:
    workers: int | None = None  # at a time; None: as many as fit
    address: str | None = None  # of a Ray cluster
    partition: str | None = None  # of a SLURM cluster


def make_engine(name: str, spec: Spec, folder: Path, options: EngineOptions) -> Engine:
    """Raises UserError when the engine's package is missing, its cluster cannot be reached, or a job takes more GPUs than
    this machine has."""
    resources = spec.resources
    if name == "local":
        names = visible_gpus()
        return LocalProcesses(resources, options.workers, gpu_places(names, spec.gpus_of_a_job(bool(names))))
    gpus = spec.gpus_of_a_job(False)
    if name == "ray":
        return RayCluster(resources, gpus, options.address, options.workers)
    return SlurmCluster(resources, gpus, folder / "slurm", options)


def workers_that_fit(resources: Resources) -> int:
    """How many jobs this machine's cores and memory hold at a time; at least one."""
    by_cores = processor_count() // resources.threads
    by_memory = int(available_bytes() // (resources.memory_gb * 2**30))
    return max(1, min(by_cores, by_memory))


def gpu_places(names: Sequence[str], each: float) -> list[str]:
    """What the jobs that run at a time may use of these GPUs, a text for CUDA_VISIBLE_DEVICES each, in turns.

    each    GPUs of a job; a part of one: so many share it
    None where there are none, or jobs take none. Raises UserError where one takes more than there are.
    """
    if not names or each == 0:
        return []
    if each > len(names):
        raise UserError(f"a job takes {each:g} GPUs, and this machine has {len(names)}: lower gpus in the sweep's file")
    if each < 1:
        return [name for _ in range(math.floor(1 / each + 1e-9)) for name in names]
    together = math.ceil(each)
    return [",".join(names[i : i + together]) for i in range(0, len(names) - together + 1, together)]


class LocalProcesses:
    """Processes of this machine. A job sees the GPUs of the place that it has, and no others."""

    name = "local"

    def __init__(self, resources: Resources, workers: int | None, places: Sequence[str] = ()) -> None:
        self.workers = workers or workers_that_fit(resources)
        if places:
            self.workers = min(self.workers, len(places))
        self._places = list(places)[: self.workers] or [""] * self.workers
        self._taken: dict[Path, str] = {}
        self._threads = resources.threads
        self._waiting: list[Path] = []
        self._running: dict[Path, Worker] = {}

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        self._waiting += folders
        self._start()
        return list(folders)

    def poll(self, handle: Any) -> str | None:
        worker = self._running.get(handle)
        said = None if worker is None else worker.poll()
        if said is None:
            return None
        del self._running[handle]
        self._places.append(self._taken.pop(handle))
        self._start()
        return said

    def stop(self, handles: Sequence[Any]) -> None:
        self._waiting = [folder for folder in self._waiting if folder not in handles]
        workers = [self._running[folder] for folder in handles if folder in self._running]
        for worker in workers:
            worker.ask_to_end()
        for worker in workers:
            worker.end()

    def close(self) -> None:
        """Nothing is held."""

    def _start(self) -> None:
        while self._waiting and len(self._running) < self.workers:
            folder = self._waiting.pop(0)
            self._taken[folder] = self._places.pop(0)
            self._running[folder] = Worker(folder, self._threads, self._taken[folder])


class RayCluster:
    """An existing Ray cluster; without an address one of this machine's own, which listens on the loopback interface alone.

    Its machines need this program installed and the sweep's folder under the same path.
    """

    name = "ray"

    def __init__(self, resources: Resources, gpus: float, address: str | None, workers: int | None) -> None:
        own = address is None and "RAY_ADDRESS" not in os.environ
        if own:  # read when Ray is imported; the name is older than its use: without it, Ray takes a public address
            os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        check_installed("--engine ray", "ray", "ray")
        ray: Any = import_module("ray")
        # Its own cluster has the processors of so many jobs: Ray would wait for ever for what it has not.
        cpus = (workers or workers_that_fit(resources)) * resources.threads
        options: dict[str, Any] = {"num_cpus": cpus, "include_dashboard": False} if own else {}
        try:
            ray.init(address=address, log_to_driver=False, logging_level="error", **options)
        except (ConnectionError, RuntimeError, ValueError) as error:
            place = f"at {address}" if address else "on this machine"
            raise UserError(f"no Ray cluster answers {place} ({str(error).splitlines()[0]})") from None
        self._ray = ray
        needs: dict[str, Any] = {"num_cpus": resources.threads}
        if not own:  # how many jobs its own memory holds is counted above
            needs["memory"] = int(resources.memory_gb * 2**30)
        if gpus:
            needs["num_gpus"] = gpus  # Ray shows a worker its own, and no others
        if shortage := too_small([node["Resources"] for node in ray.nodes() if node["Alive"]], needs):
            print(
                f"Note: no machine of the Ray cluster has {shortage}, which a job takes: jobs wait until one joins it"
            )
        # What is tried again is decided in one place, from the job's files.
        self._work = ray.remote(max_retries=0, **needs)(work_until_done)
        self._threads = resources.threads

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        return [self._work.remote(str(folder.resolve()), self._threads) for folder in folders]

    def poll(self, handle: Any) -> str | None:
        ready, _ = self._ray.wait([handle], timeout=0)
        if not ready:
            return None
        try:
            return self._ray.get(handle)
        except self._ray.exceptions.RayError as error:  # the worker, its machine, or its memory is gone
            return str(error).strip().splitlines()[0]

    def stop(self, handles: Sequence[Any]) -> None:
        for handle in handles:
            self._ray.cancel(handle, force=False)

    def close(self) -> None:
        self._ray.shutdown()


def too_small(machines: Sequence[Mapping[str, float]], needs: Mapping[str, float]) -> str:
    """What a job takes, in words, where none of a Ray cluster's machines has it; else nothing."""
    if any(all(has.get(RAY_NAMES[key], 0.0) >= value for key, value in needs.items()) for has in machines):
        return ""
    memory = [f"{needs['memory'] / 2**30:.3g} GB of memory"] if "memory" in needs else []
    gpus = [f"{needs['num_gpus']:g} GPUs"] if "num_gpus" in needs else []
    return " and ".join([f"{needs['num_cpus']} processors", *memory, *gpus])


class SlurmCluster:
    """Job arrays of a SLURM cluster, through submitit; a job that is preempted or runs out of time is queued again."""

    name = "slurm"

    def __init__(self, resources: Resources, gpus: float, folder: Path, options: EngineOptions) -> None:
        check_installed("--engine slurm", "slurm", "submitit")
        submitit: Any = import_module("submitit")
        if options.address is None and shutil.which("sbatch") is None:  # submitit would run the jobs here
            raise UserError(
                "there is no SLURM on this machine (no sbatch): start the sweep on one of its cluster's machines, or take "
                "--engine local"
            )
        try:
            self._executor = submitit.AutoExecutor(folder=folder, cluster=options.address)
        except (RuntimeError, ValueError) as error:
            raise UserError(f"submitit cannot use this machine ({error}); is it one of a SLURM cluster?") from None
        self._executor.update_parameters(
            name="avatar-sweep",
            cpus_per_task=resources.threads,
            mem_gb=resources.memory_gb,
            gpus_per_node=math.ceil(gpus),
            timeout_min=LONGEST_MINUTES,
            **({"slurm_partition": options.partition} if options.partition else {}),
            **({"slurm_array_parallelism": options.workers} if options.workers else {}),
        )
        self._work = Requeued(resources.threads)

    def submit(self, folders: Sequence[Path]) -> list[Any]:
        return list(self._executor.map_array(self._work, [str(folder.resolve()) for folder in folders]))

    def poll(self, handle: Any) -> str | None:
        if not handle.done():
            return None
        try:
            return handle.result()
        except Exception as error:  # submitit raises what it likes for workers that are gone
            return str(error).strip().splitlines()[0]

    def stop(self, handles: Sequence[Any]) -> None:
        for handle in handles:
            handle.cancel()

    def close(self) -> None:
        """The cluster keeps the jobs."""


@dataclass
class Requeued:
    """A job for submitit that goes on in a new one when SLURM takes its machine away."""

    threads: int

    def __call__(self, folder: str) -> str:
        return work_until_done(folder, self.threads)

    def checkpoint(self, folder: str) -> Any:
        import submitit

        return submitit.helpers.DelayedSubmission(self, folder)
