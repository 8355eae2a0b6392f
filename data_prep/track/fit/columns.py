"""Which columns of a frame's step are free, and derivatives gathered into them."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from data_prep.track.fit.motion import Columns
from data_prep.track.fit.surface import Derivatives


def free_columns(expressions: int, *fixed: slice) -> Int[Tensor, " D"]:
    """All columns of a step but the `fixed` ones."""
    is_free = torch.ones(Columns.EXPRESSION.start + expressions, dtype=torch.bool)
    for columns in fixed:
        is_free[columns] = False
    return torch.nonzero(is_free).squeeze(1)


def frame_columns(
    pose: Float[Tensor, "R T 6"], derivatives: Derivatives, columns: Int[Tensor, " D"]
) -> Float[Tensor, "R T D"]:
    """The free columns of R rows."""
    joints = derivatives.joints
    head = torch.cat((pose, joints[..., :7], derivatives.eyelids, joints[..., 7:]), dim=-1)
    fixed = columns[columns < Columns.EXPRESSION.start]
    expressions = columns[len(fixed) :] - Columns.EXPRESSION.start
    whole = len(expressions) == derivatives.expression.shape[-1]
    return torch.cat(
        (head[..., fixed], derivatives.expression if whole else derivatives.expression[..., expressions]), -1
    )


def spread(step: Float[Tensor, "T D"], columns: Int[Tensor, " D"], expressions: int) -> Float[Tensor, "T C"]:
    """A step of the free columns as one of all columns."""
    full = step.new_zeros(len(step), Columns.EXPRESSION.start + expressions)
    full[:, columns] = step
    return full
