"""Normals of a mesh's vertices."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from avatar.tensors import take_rows


def vertex_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Unit normals, the triangles' weighted by their areas."""
    a, b, c = take_rows(vertices, faces).unbind(dim=1)
    of_faces = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(vertices).index_add(0, faces.reshape(-1), of_faces.repeat_interleave(3, dim=0))
    return normalize(total, dim=-1)
