from __future__ import annotations

from pathlib import Path

import torch
from small_runs import open_small, small_config

from avatar.head.model import HeadModel
from avatar.train.posed_mesh_cache import PosedMeshes


def test_meshes_are_those_of_the_head_and_are_kept_while_there_is_room(tracked_folder: Path) -> None:
    _, subject, assets = open_small(tracked_folder, small_config())
    head = HeadModel(assets, subject.identity)
    frames = [subject.frame(i) for i in range(3)]
    size = head.neutral_vertices().nbytes
    meshes = PosedMeshes(head, limit_bytes=2 * size)
    first = [meshes.vertices(frame) for frame in frames]
    again = [meshes.vertices(frame) for frame in frames]
    for frame, mesh in zip(frames, first, strict=True):
        assert torch.equal(mesh, head.vertices(frame.params))
    assert [a is b for a, b in zip(first, again, strict=True)] == [True, True, False]
