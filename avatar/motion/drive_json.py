"""Drive files as JSON: ARKit's blendshapes, as LAM_Audio2Expression makes them of speech (bsData.json).

{"names": ["jawOpen", ...], "metadata": {"fps": 30.0}, "frames": [{"weights": [0.1, ...]}, ...]}
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data.json_values import parse_number
from avatar.errors import UserError
from avatar.files.read import read_json
from avatar.head.expression_names import ExpressionNames, plain
from avatar.motion.drive_csv import LARGEST_SHAPE, from_arkit


def read_drive_json(
    path: Path, num_expressions: int, names: ExpressionNames, say: Callable[[str], None]
) -> dict[str, np.ndarray]:
    """The arrays of an .npz drive file. Raises UserError with the file and the frame."""
    raw = read_json(path)
    try:
        own, weights, fps = _parse(raw)
    except ValueError as error:
        raise UserError(f"{path} is no recording of blendshapes: {error}; see docs/reenact.md") from None
    values = {plain(name): weights[:, i] for i, name in enumerate(own)}
    arrays = from_arkit(path, dict(zip(values, own, strict=True)), values, num_expressions, names, say)
    say(f"{path.name}: {len(weights)} frames, {fps:g} a second")
    return arrays | {"fps": np.array(fps)}


def _parse(raw: Any) -> tuple[list[str], np.ndarray, float]:
    """Names [K], weights [T, K] and frames a second. Raises ValueError."""
    own, frames, metadata = (raw.get(key) if isinstance(raw, dict) else None for key in ("names", "frames", "metadata"))
    if not isinstance(own, list) or not own or not all(isinstance(name, str) for name in own):
        raise ValueError('it needs "names", a list of texts')
    if len(set(map(plain, own))) < len(own):
        raise ValueError("two of its names are the same")
    if not isinstance(frames, list) or not frames:
        raise ValueError('it needs "frames", a list')
    fps = parse_number(metadata.get("fps") if isinstance(metadata, dict) else None, '"fps" in "metadata"')
    return own, np.array([_weights(frame, len(own), number) for number, frame in enumerate(frames)]), fps


def _weights(frame: Any, count: int, number: int) -> list[float]:
    weights = frame.get("weights") if isinstance(frame, dict) else None
    if not isinstance(weights, list) or len(weights) != count:
        raise ValueError(f'frame {number} needs "weights", {count} numbers')
    values = [parse_number(weight, f"a weight of frame {number}") for weight in weights]
    if max(map(abs, values)) > LARGEST_SHAPE:
        raise ValueError(f"a weight of frame {number} lies beyond +-{LARGEST_SHAPE:g}")
    return values
