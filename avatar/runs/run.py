"""Run folders: what a run was made from, and who is working in it.

RUN/run.json              input, head model, configuration, the perceptual term, versions
RUN/.lock                 the process that trains into the folder, while it does
RUN/avatar.safetensors    the avatar of the newest checkpoint (runs/avatar_file.py)
RUN/checkpoints/          to go on from (runs/checkpoint.py)
"""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from avatar.config import Config, config_from_dict
from avatar.data.json_values import parse_object
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.files.read import is_there, read_json
from avatar.gaussians.base_model import Avatar
from avatar.runs.avatar_file import AVATAR_FILE
from avatar.runs.checkpoint import list_checkpoints
from avatar.runs.trained_avatar import TrainedAvatar, load_avatar, runs_in
from avatar.version import __version__

RUN_FILE = "run.json"
RUN_FORMAT = 4
# The names under which a library may be installed; the first is what it is called here.
_OPENCV = tuple(f"opencv-{part}python{end}" for end in ("-headless", "") for part in ("contrib-", ""))
VERSIONED = (("torch",), ("numpy",), _OPENCV, ("kornia",))


@dataclass(frozen=True)
class RunInfo:
    """What run.json holds of the decisions that a run keeps."""

    source: Source
    config: Config
    options: Mapping[str, str]  # that were chosen in the configuration's groups
    perceptual: str  # what the third term of the loss came to, as `choose_perceptual` names it
    data_hash: str
    head_fingerprint: str


@dataclass(frozen=True)
class Run:
    """A run with the video that it was trained on."""

    path: Path
    trained: TrainedAvatar
    subject: Subject

    @property
    def avatar(self) -> Avatar:
        return self.trained.avatar

    @property
    def config(self) -> Config:
        return self.trained.config

    @property
    def step(self) -> int:
        return self.trained.step


def open_trained(path: Path, head: Path | None = None) -> TrainedAvatar:
    """The avatar of a run or of a file. A run, and the file in it, know where the head model of the training was."""
    run = path.parent if path.name == AVATAR_FILE else path
    is_recorded = head is None and (run / RUN_FILE).is_file()
    return load_avatar(path, head, recorded_head=read_run_info(run).source.head if is_recorded else None)


def start_run(
    path: Path,
    source: Source,
    config: Config,
    subject: Subject,
    perceptual: str,
    options: Mapping[str, str],
) -> None:
    """Write RUN/run.json; the caller holds the folder's lock.

    Raises UserError when the folder holds a trained run already: nothing is overwritten.
    """
    refuse_trained(path)
    write_run_info(
        path,
        {
            "name": subject.name,
            "source": source.to_dict(),
            "data_hash": subject.data_hash,
            "head_fingerprint": subject.head_fingerprint,
            "config": config.to_dict(),
            "options": dict(options),
            "perceptual": perceptual,
            "versions": versions(),
        },
    )


def refuse_trained(path: Path) -> None:
    """Raise UserError when the folder holds checkpoints, or an avatar whose checkpoints are gone."""
    if list_checkpoints(path / "checkpoints"):
        raise UserError(f"{path} holds a run already: add --resume to go on with it, or choose another --out")
    if is_there(path / AVATAR_FILE):
        raise UserError(f"{path} holds an avatar already, {AVATAR_FILE}: choose another --out")


def write_run_info(run: Path, info: Mapping[str, Any]) -> None:
    write_atomically(run / RUN_FILE, json.dumps({"format": RUN_FORMAT, **info}, indent=2, allow_nan=False).encode())


def read_run_info(run: Path) -> RunInfo:
    """RUN/run.json. Raises UserError when the folder is not a run, or one of another version of the program."""
    path = run / RUN_FILE
    if not is_there(path):
        raise UserError(
            f"{run} is not a run folder: it has no run.json; give the folder that avatar train wrote (--out){runs_in(run)}"
        )
    info = read_json(path)
    if not isinstance(info, dict) or info.get("format") != RUN_FORMAT:
        found = info.get("format") if isinstance(info, dict) else "none"
        raise UserError(
            f"{path} is of format {found}, and this program reads {RUN_FORMAT}; train again with this version"
        )
    try:
        return parse_object(info, RunInfo, config=config_from_dict(info["config"]))
    except (KeyError, ValueError, UserError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise UserError(f"{path} is damaged ({reason})") from None


def versions() -> dict[str, str]:
    """What a result depends on besides the configuration."""
    return {
        "avatar": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "threads": str(torch.get_num_threads()),
        **{names[0]: version_of(names) for names in VERSIONED},
    }


def version_of(names: Sequence[str]) -> str:
    """Of the first of these packages that is installed; "unknown" where none is under its name."""
    for name in names:
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "unknown"
