"""A trained avatar as one file, which is all that drawing it needs beside the head model; docs/format.md is its definition.

    RUN/avatar.safetensors    parameters, configuration, the recording that it was trained on without its pictures, the
                              neutral face, fingerprints of data and head model; perhaps the head model itself

Written with every checkpoint. Reading one cannot execute code.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as serialize
from torch import Tensor

from avatar.compute.memory import check_memory
from avatar.config import Config, config_from_dict
from avatar.data.camera_rig import parse_rig
from avatar.data.json_values import parse_intrinsics, parse_number, parse_positions, parse_value
from avatar.data.recording import TRACK_SHAPES, Recording, checked_tracks
from avatar.data.split import Split
from avatar.data.tensor_file import read_metadata, read_tensors
from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.files.names import safe_name
from avatar.files.read import MissingFile, open_file
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets
from avatar.head.expression_names import ExpressionNames, parse_expression_names
from avatar.head.head_tensors import head_from_tensors, head_tensors
from avatar.motion.neutral_pose import RestPose
from avatar.runs.checkpoint import check_fit, load_module, module_tensors
from avatar.runs.memory_estimate import count_gaussians, drawing_needs
from avatar.runs.model_registry import MODELS, make_avatar
from avatar.version import __version__

AVATAR_FILE = "avatar.safetensors"
AVATAR_FORMAT = 3
MAX_BYTES = 2**32
# How files begin that are taken for avatar files, and what they are for.
OTHER_FILES = {
    b"<!doctype html": "is a page: open it in a browser",
    b"\x1f\x8b": "is for <avatar-view> in a web page",
    b"ply\n": "holds the Gaussians of one frame, for viewers of 3D Gaussian splatting",
    b"gltf": "is a mesh, for viewers of glTF",
}
_RECORDING, _NEUTRAL, _HEAD = "recording.", "neutral.", "head."


@dataclass(frozen=True)
class AvatarFile:
    """What an avatar file holds, without the head model; enough to build the avatar once that is there."""

    config: Config
    step: int
    recording: Recording
    neutral: RestPose
    perceptual: str  # what the third term of the loss was
    names: ExpressionNames  # of the head model's coefficients
    parameters: Mapping[str, Tensor]  # "model.*"
    head: HeadAssets | None  # packed into the file


def write_avatar(
    path: Path, model: Avatar, config: Config, recording: Recording, neutral: RestPose, step: int, perceptual: str
) -> None:
    """Write the avatar after `step` steps. Raises UserError when the disk refuses."""
    names = model.head.assets.names
    write_avatar_file(
        path, AvatarFile(config, step, recording, neutral, perceptual, names, module_tensors(model), None)
    )


def write_avatar_file(path: Path, content: AvatarFile, licence: str | None = None) -> None:
    """Write what `read_avatar_file` gives back; `licence` is a sentence about the head model, where one is packed."""
    recording = content.recording
    tensors = {name: value.detach().cpu().contiguous() for name, value in content.parameters.items()}
    tensors |= {f"{_RECORDING}{name}": recording.tracks[name].contiguous() for name in TRACK_SHAPES}
    tensors |= {
        f"{_NEUTRAL}expression": content.neutral.expression.contiguous(),
        f"{_NEUTRAL}jaw": content.neutral.jaw.contiguous(),
    }
    if content.head is not None:
        tensors |= {f"{_HEAD}{name}": value for name, value in head_tensors(content.head).items()}
    header = {
        "format": AVATAR_FORMAT,
        "program": __version__,
        "step": content.step,
        "config": content.config.to_dict(),
        "perceptual": content.perceptual,
        "name": recording.name,
        "fps": recording.fps,
        "size": [recording.width, recording.height],
        "intrinsics": list(recording.intrinsics),
        "frames": list(recording.names),
        "train": list(recording.split.train),
        "test": list(recording.split.test),
        "neutral_frame": content.neutral.frame,
        "data_hash": recording.data_hash,
        "head_fingerprint": recording.head_fingerprint,
        "expression_names": content.names.to_dict(),
        "head_licence": licence,
        **({} if recording.rig is None else {"rig": recording.rig.to_dict()}),
    }
    write_atomically(path, serialize(tensors, metadata={"avatar": json.dumps(header, allow_nan=False)}))


def read_avatar_file(path: Path) -> AvatarFile:
    """Read an avatar file. Raises UserError, naming the file, when it is missing, damaged or of another format."""
    header, tensors = _read(path)
    try:
        return _parse(header, tensors)
    except UserError as error:
        raise UserError(f"{path} cannot be used: {error}") from None
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise UserError(f"{path} is damaged ({reason}); copy it again, or export it again") from None


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with open_file(path, MAX_BYTES) as file:
            start = file.read(16).lower()
    except MissingFile:
        raise UserError(
            f"there is no avatar file {path}; give the folder that avatar train wrote, or a file of it"
        ) from None
    if what := next((what for beginning, what in OTHER_FILES.items() if start.startswith(beginning)), None):
        raise UserError(f"{path} {what}; this takes the run that it was exported from, or its {AVATAR_FILE}")
    try:
        header = json.loads(read_metadata(path, MAX_BYTES).get("avatar", "null"))
        if not isinstance(header, dict) or header.get("format") != AVATAR_FORMAT or "frames" not in header:
            found = header.get("format") if isinstance(header, dict) else "none"
            raise UserError(f"{path} is not an avatar of this program (format {found}, expected {AVATAR_FORMAT})")
        return header, read_tensors(path, MAX_BYTES)
    except UserError as error:
        raise UserError(f"{error}; copy it again, or export it again") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is damaged or no avatar file ({error}); copy it again, or export it again") from None


def _parse(header: dict[str, Any], tensors: dict[str, Tensor]) -> AvatarFile:
    config = config_from_dict(header["config"])
    names = header["frames"]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError("frames is not a list of names")
    count = len(names)
    width, height = parse_value(header["size"], tuple[int, int], "size")
    if not 1 <= width < 2**16 or not 1 <= height < 2**16:
        raise ValueError(f"an image size of {width}x{height} is impossible")
    fps = parse_number(header["fps"], "fps")
    intrinsics = parse_intrinsics(header["intrinsics"])
    if fps <= 0 or min(intrinsics[:2]) <= 0:
        raise ValueError("fps and focal lengths must be positive")
    for key, kind in (("name", str), ("data_hash", str), ("head_fingerprint", str), ("perceptual", str), ("step", int)):
        parse_value(header[key], kind, key)
    rig = parse_rig(header["rig"], count) if "rig" in header else None
    rows = count if rig is None else max(rig.times) + 1
    recording = Recording(
        name=safe_name(header["name"]),
        fps=fps,
        width=width,
        height=height,
        intrinsics=intrinsics,
        names=tuple(names),
        split=Split(parse_positions(header["train"], "train", count), parse_positions(header["test"], "test", count)),
        tracks=checked_tracks(_under(_RECORDING, tensors), rows),
        data_hash=header["data_hash"],
        head_fingerprint=header["head_fingerprint"],
        rig=rig,
    )
    coefficients = recording.tracks["expression"].shape[1]
    head = _under(_HEAD, tensors)
    return AvatarFile(
        config=config,
        step=header["step"],
        recording=recording,
        neutral=_parse_neutral(header["neutral_frame"], _under(_NEUTRAL, tensors), recording),
        perceptual=header["perceptual"],
        names=parse_expression_names(header["expression_names"], coefficients, "expression_names"),
        parameters={name: value for name, value in tensors.items() if name.startswith("model.")},
        head=head_from_tensors(head) if head else None,
    )


def _parse_neutral(frame: Any, tensors: Mapping[str, Tensor], recording: Recording) -> RestPose:
    expression, jaw = tensors["expression"].float(), tensors["jaw"].float()
    if expression.shape != recording.tracks["expression"].shape[1:] or jaw.shape != (3, 3):
        raise ValueError(f"the neutral face has shapes {list(expression.shape)} and {list(jaw.shape)}")
    if not bool(torch.isfinite(expression).all() and torch.isfinite(jaw).all()):
        raise ValueError("the neutral face is not finite")
    if frame is not None and (
        not isinstance(frame, int) or not 0 <= frame < len(recording.moments(recording.split.train))
    ):
        raise ValueError(f"neutral_frame is {frame!r}")
    return RestPose(expression, jaw, frame)


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def build_avatar(content: AvatarFile, assets: HeadAssets, source: Path | str) -> Avatar:
    """The avatar with its parameters, ready to draw.

    Raises UserError for another head model than it was trained with, and, before anything large is made, for parameters
    that do not fit the configuration or the machine's memory.
    """
    check_head(content.recording.head_fingerprint, assets, source)
    config = content.config.model
    gaussians = count_gaussians(config, assets)
    shapes = MODELS[config.name].shapes(config, assets.num_expressions, gaussians)
    check_fit(shapes, content.parameters, source)
    check_memory(f"opening {source}", drawing_needs(config, assets, gaussians))
    model = make_avatar(assets, content.recording.identity, config)
    load_module(model, content.parameters, source)
    return model.eval()


def check_head(fingerprint: str, assets: HeadAssets, source: Path | str) -> None:
    if fingerprint != assets.fingerprint:
        raise UserError(
            f"the avatar in {source} was trained with another head model (fingerprint {fingerprint[:12]}, this one "
            f"{assets.fingerprint[:12]}); give its own with --head"
        )
