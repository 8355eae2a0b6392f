"""The posed meshes of training frames: they do not change while the avatar does, so each is computed once."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from avatar.gaussians.base_model import Avatar
from avatar.head.model import HeadModel
from avatar.types import Frame

LIMIT_BYTES = 2**28  # 4,400 frames of FLAME's 5,023 vertices; what does not fit is computed again


class PosedMeshes:
    """Vertices by frame, kept from their first use on while there is room."""

    def __init__(self, head: HeadModel | Avatar, limit_bytes: int = LIMIT_BYTES) -> None:
        self._head = head
        self._room = limit_bytes
        self._meshes: dict[int, Tensor] = {}

    def vertices(self, frame: Frame) -> Float[Tensor, "V 3"]:
        """`head.vertices(frame.params)`, metres."""
        mesh = self._meshes.get(frame.index)
        if mesh is None:
            mesh = self._head.vertices(frame.params)
            if mesh.nbytes <= self._room:
                self._room -= mesh.nbytes
                self._meshes[frame.index] = mesh
        return mesh
