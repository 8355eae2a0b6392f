"""The file that says what a sweep trains; docs/sweep.md is its definition."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avatar.config import load_config
from avatar.errors import UserError
from avatar.evaluation.protocol import choose_protocols
from avatar.files.environment import expanded
from avatar.files.plain_yaml import read_yaml

MAX_BYTES, MAX_JOBS = 2**20, 100_000
MAX_VARIANTS = 1000  # each is composed and checked before the first job begins
KEYS = {
    "subjects",
    "head",
    "variants",
    "product",
    "overrides",
    "seeds",
    "protocols",
    "threads",
    "memory_gb",
    "gpus",
    "retries",
}
SUBJECT_KEYS = {"folder", "head", "name", "tracking", "frame_offset", "data_format", "fps"}
SEED_KEY = "trainer.seed"


@dataclass(frozen=True)
class Resources:
    """What one job takes."""

    threads: int = 2
    memory_gb: float = 3.0
    gpus: float | None = None  # None: one where a job may use it, see `gpus_of_a_job`


@dataclass(frozen=True)
class Job:
    """One training and its evaluation."""

    name: str  # a folder's name, of its own in the sweep
    subject: str
    variant: str
    seed: int
    source: Mapping[str, Any]  # folder, and what else belongs to it, as `avatar train` takes them
    overrides: tuple[str, ...]
    protocols: tuple[str, ...]

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> Job:
        """What `asdict` gave. Raises KeyError, TypeError or ValueError for anything else: each value becomes a word of a
        command, and no word may be read as an option."""
        job = cls(**{**raw, "overrides": tuple(raw["overrides"]), "protocols": tuple(raw["protocols"])})
        source, texts = job.source, (job.name, job.subject, job.variant, *job.overrides, *job.protocols)
        if not isinstance(source, dict) or not isinstance(source["folder"], str) or source.keys() - SUBJECT_KEYS:
            raise TypeError("source is no table with a folder")
        words = [*job.overrides, *job.protocols, *source.values()]
        if wrong := [word for word in words if not _is_word(word)]:
            raise ValueError(f"{str(wrong[0])[:40]!r} is no word")
        if not all(isinstance(text, str) for text in texts) or job.name in ("", ".", ".."):
            raise TypeError("a name or an override is not text")
        return job


@dataclass(frozen=True)
class Spec:
    jobs: tuple[Job, ...]
    resources: Resources
    retries: int

    def gpus_of_a_job(self, are_there: bool) -> float:
        """How many GPUs a job is given: what the file says; else one where GPUs `are_there` and a job may use one.

        Where nobody knows, as for a cluster's machines, only jobs that ask for a GPU by name get one.
        """
        if self.resources.gpus is not None:
            return self.resources.gpus
        wanted = {_device(job.overrides) for job in self.jobs}
        return 1.0 if "cuda" in wanted or (are_there and "auto" in wanted) else 0.0


def read_spec(path: Path) -> Spec:
    """Read a sweep's file; relative paths in it count from its folder.

    Raises UserError naming the key that is unknown, missing or wrong, and for overrides that `avatar train` would refuse.
    """
    raw = read_yaml(path, MAX_BYTES)
    if not isinstance(raw, dict):
        raise UserError(f"{path} holds no keys; a sweep has {', '.join(sorted(KEYS))}")
    if unknown := sorted(map(str, raw.keys() - KEYS)):
        raise UserError(f"{path}: there is no key '{unknown[0]}'; a sweep has {', '.join(sorted(KEYS))}")
    subjects = [_subject(path, entry, raw.get("head")) for entry in _list(path, raw, "subjects")]
    names = [subject["name"] for subject in subjects]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UserError(f"{path}: two subjects are called {twice[0]}; give them a `name`")
    variants = _variants(path, raw)
    common = _words(path, "overrides", raw.get("overrides", []))
    seeds = _list(path, raw, "seeds", [0])
    if wrong := [seed for seed in seeds if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0]:
        raise UserError(f"{path}: seeds holds {wrong[0]!r}, which is no number from 0 up")
    if len(set(seeds)) < len(seeds):
        raise UserError(f"{path}: seeds names one twice")
    if any(word.partition("=")[0] == SEED_KEY for words in (common, *variants.values()) for word in words):
        raise UserError(f"{path}: {SEED_KEY} is what seeds says; list its values there")
    protocols = _protocols(path, _words(path, "protocols", raw.get("protocols", [])))
    if len(subjects) * len(variants) * len(seeds) > MAX_JOBS:
        raise UserError(f"{path} asks for more than {MAX_JOBS:,} jobs; split it into several sweeps")
    jobs = [
        Job(
            name=_folder_name(subject["name"], variant, seed),
            subject=subject["name"],
            variant=variant,
            seed=seed,
            source={key: value for key, value in subject.items() if key != "name"},
            overrides=(*common, *overrides, f"{SEED_KEY}={seed}"),
            protocols=protocols,
        )
        for subject, (variant, overrides), seed in itertools.product(subjects, variants.items(), seeds)
    ]
    for variant, overrides in variants.items():
        _check_overrides(path, variant, [*common, *overrides, f"{SEED_KEY}={max(seeds)}"])
    resources = Resources(
        threads=int(_number(path, raw, "threads", Resources.threads, 1, 1024)),
        memory_gb=_number(path, raw, "memory_gb", Resources.memory_gb, 0.1, 10_000),
        gpus=_number(path, raw, "gpus", 0, 0, 64) if "gpus" in raw else None,
    )
    return Spec(tuple(jobs), resources, int(_number(path, raw, "retries", 2, 0, 100)))


def _protocols(path: Path, words: list[str]) -> tuple[str, ...]:
    """Names, and paths of files. Raises UserError as `avatar eval` does, before anything is trained."""
    is_file = [word.endswith((".yaml", ".yml")) for word in words]
    placed = [str(path.resolve().parent / word) if file else word for word, file in zip(words, is_file, strict=True)]
    if placed:
        try:
            choose_protocols(placed)
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
    return tuple(placed)


def _subject(path: Path, entry: Any, head: Any) -> dict[str, Any]:
    entry = {"folder": entry} if isinstance(entry, str) else entry
    if not isinstance(entry, dict) or not isinstance(entry.get("folder"), str):
        raise UserError(f"{path}: subjects holds {entry!r}, which names no folder")
    if unknown := sorted(map(str, entry.keys() - SUBJECT_KEYS)):
        raise UserError(f"{path}: a subject has no key '{unknown[0]}'; it has {', '.join(sorted(SUBJECT_KEYS))}")
    found = {"head": head, **entry}
    for key in ("folder", "head", "tracking"):
        if (value := found.get(key)) is not None:
            if not isinstance(value, str) or "\0" in value:
                raise UserError(f"{path}: {key} is {value!r}, not a path")
            found[key] = str((path.resolve().parent / expanded(value, f"{path}: {key} {value}")).resolve())
    for key in ("frame_offset", "data_format", "fps"):
        if (value := found.get(key)) is not None and not _is_word(value):
            raise UserError(f"{path}: {key} is {value!r}, not a word or a number")
    name = found.get("name", Path(found["folder"]).name)
    if not isinstance(name, str) or not name:
        raise UserError(f"{path}: a subject's name is {name!r}, not text")
    return {"name": name, **{key: value for key, value in found.items() if key != "name" and value is not None}}


def _variants(path: Path, raw: Mapping[str, Any]) -> dict[str, list[str]]:
    """Name -> overrides, from a list, a table, or the product of lists of values."""
    if "variants" in raw and "product" in raw:
        raise UserError(f"{path}: give variants or product, not both")
    if "product" in raw:
        product = raw["product"]
        if not isinstance(product, dict) or not all(isinstance(values, list) and values for values in product.values()):
            raise UserError(f"{path}: product must hold a list of values for each key")
        count = math.prod(map(len, product.values()))
        if count > MAX_VARIANTS:
            raise UserError(f"{path}: product makes {count:,} variants; up to {MAX_VARIANTS:,} are tried")
        choices = [[f"{key}={_plain(path, key, value)}" for value in values] for key, values in product.items()]
        return {" ".join(words): list(words) for words in itertools.product(*choices)}
    given = raw.get("variants", {"default": []})
    if isinstance(given, list):
        given = {" ".join(_words(path, "variants", words)) or "default": words for words in given}
    if not isinstance(given, dict) or not given:
        raise UserError(f"{path}: variants must name at least one list of overrides")
    if len(given) > MAX_VARIANTS:
        raise UserError(f"{path} has {len(given):,} variants; up to {MAX_VARIANTS:,} are tried")
    return {str(name): _words(path, f"variants.{name}", words) for name, words in given.items()}


def _plain(path: Path, key: Any, value: Any) -> str:
    try:
        return json.dumps(value, allow_nan=False) if isinstance(value, (bool, list, type(None))) else str(value)
    except (TypeError, ValueError) as error:  # a date in a list, or .nan
        raise UserError(f"{path}: product.{key} holds what no override can be ({error})") from None


def _check_overrides(path: Path, variant: str, overrides: list[str]) -> None:
    try:
        load_config(overrides)
    except UserError as error:
        raise UserError(f"{path}: variant {variant}: {error}") from None
    if ":" in _device(overrides):
        raise UserError(
            f"{path}: variant {variant}: a sweep hands out the GPUs itself; say device=cuda, without a number"
        )


def _device(overrides: Sequence[str]) -> str:
    """auto, cpu, cuda or cuda:N."""
    return next((word.partition("=")[2] for word in reversed(overrides) if word.startswith("device=")), "auto")


def _words(path: Path, key: str, value: Any) -> list[str]:
    words = [value] if isinstance(value, str) else value
    if not isinstance(words, list) or not all(isinstance(word, str) and _is_word(word) for word in words):
        raise UserError(f"{path}: {key} must be a list of texts, such as [model.latent_dim=4]")
    return words


def _is_word(value: Any) -> bool:
    """Whether a command takes the value as such, not as an option."""
    return isinstance(value, (int, float)) or (isinstance(value, str) and not value.startswith("-"))


def _list(path: Path, raw: Mapping[str, Any], key: str, default: list[Any] | None = None) -> list[Any]:
    value = raw.get(key, default)
    if not isinstance(value, list) or not value:
        raise UserError(f"{path}: {key} must be a list with at least one entry")
    return value


def _number(path: Path, raw: Mapping[str, Any], key: str, default: float, low: float, high: float) -> float:
    value = raw.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise UserError(f"{path}: {key} is {value!r}; it must lie between {low:g} and {high:g}")
    return value


def _folder_name(subject: str, variant: str, seed: int) -> str:
    """Readable, and never the same for two jobs."""
    readable = re.sub(r"[^0-9A-Za-z.=-]+", "_", f"{subject}-{variant}")[:80]
    digest = hashlib.sha256(json.dumps([subject, variant], allow_nan=False).encode()).hexdigest()[:6]
    return f"{readable}-{digest}-seed{seed}"
