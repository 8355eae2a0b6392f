"""A run: one avatar with the data and the head model that it was trained on, found again from its folder."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

import avatar
from avatar.checkpoint import (
    Checkpoint,
    list_checkpoints,
    load_module,
    newest_checkpoint,
    read_run_info,
    write_run_info,
)
from avatar.config import Config, config_from_dict
from avatar.data.split import SplitSizes
from avatar.data.subject import Subject
from avatar.data_prep.prepare import prepare
from avatar.errors import UserError
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.model import Avatar

HEAD_VARIABLE = "AVATAR_HEAD"
VERSIONED = ("torch", "numpy", "opencv-contrib-python-headless", "kornia")


@dataclass(frozen=True)
class Source:
    """Where a subject comes from: what `avatar train` is given."""

    folder: Path
    head: Path
    tracking: Path | None = None
    frame_offset: int | None = None
    format: str | None = None


@dataclass(frozen=True)
class Run:
    """A trained avatar with what belongs to it."""

    path: Path
    config: Config
    avatar: Avatar
    subject: Subject
    source: Source
    step: int


def find_head(folder: Path, given: Path | None = None) -> Path:
    """The head model of a subject: the one given, else FOLDER/head_model, else $AVATAR_HEAD; UserError otherwise."""
    check_folder(folder)
    if given is not None:
        return given
    if (folder / "head_model").is_dir():
        return folder / "head_model"
    if named := os.environ.get(HEAD_VARIABLE):
        return Path(named)
    raise UserError(
        f"no head model for {folder}: give --head PATH, or set {HEAD_VARIABLE}. FLAME 2023 Open (CC-BY-4.0) can be had "
        "from https://flame.is.tue.mpg.de; put generic_model.pkl, head_template.obj and FLAME_masks.pkl into one folder"
    )


def check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder; give the tracked video folder (docs/data.md)")


def open_subject(
    source: Source, config: Config | None, say: Callable[[str], None], assets: HeadAssets | None = None
) -> tuple[Subject, HeadAssets]:
    """Prepare the subject (from the cache when nothing changed) and open it with its head model."""
    check_folder(source.folder)
    assets = assets or load_head_assets(source.head)
    sizes = SplitSizes() if config is None else SplitSizes(config.data.train_frames, config.data.test_frames)
    prepared = prepare(
        source.folder,
        assets,
        source.head,
        tracking=source.tracking,
        frame_offset=source.frame_offset,
        format=source.format,
        split=sizes,
        say=say,
    )
    return Subject.open(prepared), assets


def start_run(path: Path, source: Source, config: Config, subject: Subject) -> None:
    """Write RUN/run.json. Raises UserError when the folder holds a trained run already: nothing is overwritten."""
    if list_checkpoints(path / "checkpoints"):
        raise UserError(f"{path} holds a run already: add --resume to go on with it, or choose another --out")
    write_run_info(
        path,
        {
            "name": subject.name,
            "folder": str(source.folder.resolve()),
            "head": str(source.head.resolve()),
            "tracking": str(source.tracking.resolve()) if source.tracking else None,
            "frame_offset": source.frame_offset,
            "folder_format": source.format,
            "data_hash": subject.data_hash,
            "head_fingerprint": subject.head_fingerprint,
            "config": config.to_dict(),
            "versions": versions(),
        },
    )


def load_run(path: Path, head: Path | None = None, say: Callable[[str], None] = print) -> Run:
    """Open a run folder with its newest checkpoint.

    Raises UserError when there is no checkpoint, when the head model is another one than the avatar was trained with, or
    when the video folder is gone or has changed.
    """
    info = read_run_info(path)
    checkpoint = newest_checkpoint(path)
    config, source = read_source(path, info, head)
    subject, assets = open_subject(source, config, say)
    check_same(path, checkpoint, subject, assets)
    model = Avatar(assets, subject.identity, config.model)
    load_module(model, checkpoint, path)
    return Run(path, config, model.eval(), subject, source, checkpoint.step)


def read_source(path: Path, info: dict[str, Any], head: Path | None) -> tuple[Config, Source]:
    """Configuration and source out of run.json; `head` stands in for a head model that has moved."""
    try:
        config = config_from_dict(info["config"])
        tracking, offset = info["tracking"], info["frame_offset"]
        folder, recorded_head = Path(info["folder"]), Path(info["head"])
        source = Source(
            folder, head or recorded_head, Path(tracking) if tracking else None, offset, info.get("folder_format")
        )
    except (KeyError, TypeError) as error:
        raise UserError(f"{path / 'run.json'} is damaged: {error} is missing or of the wrong type") from None
    return config, source


def check_same(path: Path, checkpoint: Checkpoint, subject: Subject, assets: HeadAssets) -> None:
    """Refuse to mix an avatar with another head model or with data that changed since it was trained."""
    trained_on = checkpoint.meta.get("head_fingerprint")
    if trained_on != assets.fingerprint:
        raise UserError(
            f"the avatar in {path} was trained with another head model (fingerprint {str(trained_on)[:12]}, this one "
            f"{assets.fingerprint[:12]}); give its own with --head"
        )
    if checkpoint.meta.get("data_hash") != subject.data_hash:
        raise UserError(f"the data of {subject.name} has changed since {path} was trained; train again, or restore it")


def versions() -> dict[str, str]:
    """What a result depends on besides the configuration."""
    return {
        "avatar": avatar.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "threads": str(torch.get_num_threads()),
        **{name: version(name) for name in VERSIONED},
    }
