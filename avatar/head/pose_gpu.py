"""Posing of a head on a GPU without gradients: three launches."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.head.model import PoseTensors
from avatar.kernels.launch import start
from avatar.kernels.pose import FEATURES, TRANSFORM, blend, pose
from avatar.types import HeadParams

LANES = 128  # vertices of a program


def pose_gpu(head: PoseTensors, params: HeadParams) -> Float[Tensor, "V 3"]:
    """`HeadModel.vertices` for parameters on the same GPU, which are not differentiated."""
    parts = (params.expression, params.neck, params.jaw, params.eyes, params.eyelids)
    expression, neck, jaw, eyes, eyelids = (part.detach().float().contiguous() for part in parts)
    expressions = head.joint_directions.shape[1]
    coefficients = head.shape.new_empty(expressions + FEATURES.value)
    transforms = head.shape.new_empty(5, TRANSFORM.value)
    start(
        pose,
        1,
        expression,
        neck,
        jaw,
        eyes,
        head.joints,
        head.joint_directions,
        len(expression),
        expressions,
        coefficients,
        transforms,
        warps=1,
        EXPRESSIONS=1 << max(expressions - 1, 0).bit_length(),
    )
    shape = torch.addmv(head.shape, head.basis, coefficients)
    vertices = head.shape.new_empty(len(head.weights), 3)
    start(
        blend,
        -(-len(vertices) // LANES),
        shape,
        head.weights,
        transforms,
        eyelids,
        head.eyelid_directions,
        len(vertices),
        vertices,
        warps=LANES // 32,
        BLOCK=LANES,
    )
    return vertices
