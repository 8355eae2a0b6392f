"""Everything that a tracking is made from, for the keys of what is cached of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from avatar.files.third_party import FACE_LANDMARKER, sha256_of
from avatar.head.assets import HeadAssets
from data_prep.track.faces.embedding import official_file
from data_prep.track.faces.rendered_embedding import RECIPE
from data_prep.track.footage.source import Footage
from data_prep.track.mattes.segmentation_network import matte_network
from data_prep.track.stage_folder import hash_of

STAGES_VERSION = 19  # raised when what a stage makes changes


def tracking_key(footage: Footage, choices: dict[str, Any], head_path: Path, head: HeadAssets) -> str:
    """Of the whole tracking; `choices` are those of `Choices.to_json`."""
    return hash_of([look_inputs(footage), choices, head_inputs(head_path, head), matte_network().sha256])


def look_inputs(footage: Footage) -> dict[str, Any]:
    """Of the landmarks."""
    return {"video": footage.content_hash, "version": STAGES_VERSION, "landmarks": FACE_LANDMARKER.sha256}


def head_inputs(head_path: Path, head: HeadAssets) -> dict[str, Any]:
    """Of the fit: the head model's arrays, the names of its coefficients, and where the landmarks lie on it."""
    official = official_file(head_path)
    embedding = sha256_of(official) if official.is_file() else [RECIPE, FACE_LANDMARKER.sha256]
    return {"head": head.fingerprint, "names": head.names.to_dict(), "embedding": embedding}
