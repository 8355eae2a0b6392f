"""Files that the program writes and that people pass on: avatar files, tracked folders, landmarks; and sweeps' files."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from as_tracked import write_as_tracked
from camera_rig_folder import HEIGHT, WIDTH, write_single
from lively import lively_run
from target import Target, member, of_copy, on_disk, with_member
from tracked_folder import write_tracked_folder

from avatar.data.refinement_history import Refinement, Round
from avatar.data.source import Source
from avatar.errors import refuse
from avatar.head.assets import load_head_assets
from avatar.runs.avatar_file import AVATAR_FILE, read_avatar_file, write_avatar_file
from avatar.runs.trained_avatar import load_avatar
from avatar.sweep.spec import read_spec
from data_prep.formats import avatar_track
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.refined_folder import REFINEMENT_FILE, write_folder
from data_prep.prepare.open_subject import open_subject
from data_prep.track.faces.embedding import OFFICIAL_FILE, official_embedding
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks, load_landmarks, save_landmarks

SWEEP = b"""subjects: [../anna, {folder: ../carla, head: ../head_model, frame_offset: 1}]
head: ../head_model
product: {model.latent_dim: [4, 8], experiment: [demo, paper]}
overrides: [data.size=256]
seeds: [0, 1, 2]
protocols: [hypergaussians]
threads: 2
memory_gb: 3
retries: 2
"""


def make_own_targets(place: Path) -> dict[str, Target]:
    """`place` is an empty folder for the files that readers open."""
    original = write_tracked_folder(place / "png", 24, 24, suffix=".png")
    model = original / "head_model"
    head = load_head_assets(model)
    tracked = write_as_tracked(original, place / "as tracked")

    def of_tracked(folder: Path) -> object:
        return avatar_track.open_folder(folder).read(head, (24, 24), refuse)

    refined = refined_rig(place / "rig")
    rig_head = load_head_assets(place / "rig" / "head_model")

    def of_refined(folder: Path) -> None:
        opened = open_tracked_folder(folder)
        opened.read(rig_head, (WIDTH, HEIGHT), refuse)
        if opened.read_given is not None:
            opened.read_given(refuse)

    file = lively_run(original, place / "lively") / AVATAR_FILE
    packed = place / "packed.safetensors"
    write_avatar_file(packed, replace(read_avatar_file(file), head=head), "a licence")

    tracks, landmarks = (tracked / avatar_track.TRACKS_FILE).read_bytes(), place / "landmarks.npz"
    rng = np.random.default_rng(0)
    points, scores = rng.random((3, NUM_POINTS, 3), np.float32), rng.random((3, len(BLENDSHAPES)), np.float32)
    save_landmarks(landmarks, Landmarks(points, scores, np.ones(3, bool), (24, 24), 25.0))
    embedding = model / OFFICIAL_FILE
    weights = np.full((4, 3), 1 / 3)
    np.savez(embedding, lmk_face_idx=np.arange(4), lmk_b_coords=weights, landmark_indices=np.arange(4))

    def in_tracks(data: bytes) -> bytes:
        return with_member(tracks, "expression.npy", data)

    return {
        "avatar file": Target([file.read_bytes()], on_disk(place / "a.safetensors", lambda p: load_avatar(p, model))),
        "avatar file, its text": Target(
            [_text(file.read_bytes())],
            on_disk(place / "b.safetensors", lambda p: load_avatar(p, model)),
            2,
            _with_text(file.read_bytes()),
        ),
        "avatar file with its head": Target([packed.read_bytes()], on_disk(place / "c.safetensors", load_avatar)),
        "tracked folder": Target(
            [(tracked / avatar_track.INFO_FILE).read_bytes()],
            of_copy(place, tracked / avatar_track.INFO_FILE, tracked, of_tracked),
            2,
        ),
        "its tracking": Target([tracks], of_copy(place, tracked / avatar_track.TRACKS_FILE, tracked, of_tracked)),
        "its tracking, checksums right": Target(
            [member(tracks, "expression.npy")], on_disk(tracked / avatar_track.TRACKS_FILE, lambda _: of_tracked(tracked)),
            1, in_tracks,
        ),
        "refined folder": Target(
            [(refined / REFINEMENT_FILE).read_bytes()],
            of_copy(place, refined / REFINEMENT_FILE, refined, of_refined),
            2,
        ),
        "landmarks": Target([landmarks.read_bytes()], on_disk(place / "x-landmarks.npz", load_landmarks)),
        "embedding": Target(
            [embedding.read_bytes()], on_disk(embedding, lambda p: official_embedding(p.parent, head)), 0.5
        ),
        "sweep": Target([SWEEP], on_disk(place / "sweep.yaml", read_spec)),
    }  # fmt: skip


def refined_rig(place: Path) -> Path:
    """A refined folder of several cameras."""
    source = Source(write_single(place), place / "head_model")
    subject, _ = open_subject(source, None, lambda _: None)
    refinement = Refinement("VHAP", (Round("run", 1, "0" * 64, subject.split.train),))
    write_folder(place / "refined", subject, subject.recording.tracks, refinement, {})
    return place / "refined"


def _text(file: bytes) -> bytes:
    """The JSON text in an avatar file."""
    return json.loads(_header(file))["__metadata__"]["avatar"].encode()


def _with_text(file: bytes) -> Callable[[bytes], bytes]:
    """What puts another text into an avatar file, whose tensors stay as they are."""
    header, tensors = json.loads(_header(file)), file[8 + len(_header(file)) :]

    def put(text: bytes) -> bytes:
        header["__metadata__"] = {"avatar": text.decode("utf-8", "replace")}
        packed = json.dumps(header).encode()
        return struct.pack("<Q", len(packed)) + packed + tensors

    return put


def _header(file: bytes) -> bytes:
    (length,) = struct.unpack("<Q", file[:8])
    return file[8 : 8 + length]
